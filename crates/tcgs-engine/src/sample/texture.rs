//! Procedural colors of the solids, as linear-light albedo in [0, 1].

use glam::DVec3;
use libm::{atan2, floor, sin};

/// How a surface is painted.
#[derive(Debug, Clone, Copy)]
pub(super) enum Texture {
    /// Stone tiles with worn edges and grain, turning into bare earth away from the middle.
    Tiles,
    /// Soft clouds on a gradient.
    Sky,
    /// Dark lacquer with fine veins.
    Lacquer,
    /// A patchwork of small squares.
    Patchwork,
    /// Stripes across a ring.
    Bands,
    /// A stripe that climbs around a column.
    Helix,
    /// One color with a little grain.
    Plain(DVec3),
}

impl Texture {
    /// The albedo at a point in the solid's own frame whose normal in the world is `normal`.
    pub(super) fn albedo(&self, p: DVec3, normal: DVec3) -> DVec3 {
        match *self {
            Texture::Tiles => tiles(p),
            Texture::Sky => sky(p),
            Texture::Lacquer => {
                let vein = sin(9.0 * p.z + 7.0 * fbm(p * 4.0, 4)).abs();
                mix(DVec3::new(0.85, 0.52, 0.20), DVec3::new(0.42, 0.018, 0.022), smooth(0.02, 0.16, vein))
            }
            Texture::Patchwork => patchwork(p, normal),
            Texture::Bands => {
                let wave = sin(14.0 * atan2(p.y, p.x) + 2.0 * fbm(p * 3.0, 2));
                let cloth = 0.85 + 0.3 * noise(p * 40.0);
                let stripe = smooth(-0.12, 0.12, wave);
                mix(DVec3::new(0.04, 0.10, 0.34), DVec3::new(0.80, 0.72, 0.55), stripe) * cloth
            }
            Texture::Helix => {
                let wave = sin(3.0 * atan2(p.y, p.x) + 14.0 * p.z);
                let grain = 0.75 + 0.5 * fbm(DVec3::new(p.x * 20.0, p.y * 20.0, p.z * 6.0), 3);
                let stripe = smooth(-0.15, 0.15, wave);
                mix(DVec3::new(0.07, 0.28, 0.16), DVec3::new(0.72, 0.46, 0.10), stripe) * grain
            }
            Texture::Plain(color) => color * (0.85 + 0.3 * noise(p * 25.0)),
        }
    }
}

fn tiles(p: DVec3) -> DVec3 {
    const TILE: f64 = 0.4;
    let (u, v) = (p.x / TILE, p.y / TILE);
    let (column, row) = (floor(u), floor(v));
    let odd = (column + row).rem_euclid(2.0) >= 1.0;
    let tint = 0.8 + 0.4 * lattice(column as i64, row as i64, 7);
    let stone = if odd { DVec3::new(0.12, 0.17, 0.19) } else { DVec3::new(0.62, 0.57, 0.48) };
    let grain = 0.7 + 0.6 * fbm(p * 9.0, 5);
    let edge = [u - column, v - row].into_iter().map(|share| share.min(1.0 - share)).fold(1.0, f64::min);
    let joint = smooth(0.015, 0.05, edge + 0.03 * (noise(p * 18.0) - 0.5));
    let tile = mix(DVec3::splat(0.06), stone * (tint * grain), joint);
    let earth = DVec3::new(0.30, 0.24, 0.16) * (0.55 + 0.9 * fbm(p * 1.3, 4));
    let worn = p.truncate().length() + 0.9 * (fbm(p * 1.7, 3) - 0.5);
    mix(tile, earth, smooth(2.0, 2.5, worn))
}

/// The dome is emissive, so this is its radiance.
fn sky(p: DVec3) -> DVec3 {
    let direction = p.normalize_or_zero();
    let height = direction.z.max(0.0);
    let blue = mix(DVec3::new(0.72, 0.78, 0.82), DVec3::new(0.16, 0.34, 0.66), smooth(0.0, 0.75, height));
    let clouds = smooth(0.48, 0.72, fbm(direction * DVec3::new(2.4, 2.4, 5.0), 4));
    mix(blue, DVec3::splat(0.86), 0.75 * clouds)
}

fn patchwork(p: DVec3, normal: DVec3) -> DVec3 {
    const PALETTE: [DVec3; 6] = [
        DVec3::new(0.62, 0.16, 0.08),
        DVec3::new(0.78, 0.62, 0.30),
        DVec3::new(0.09, 0.26, 0.32),
        DVec3::new(0.66, 0.63, 0.56),
        DVec3::new(0.24, 0.10, 0.22),
        DVec3::new(0.20, 0.38, 0.12),
    ];
    const PATCH: f64 = 0.14;
    // The block's faces are halfway between borders of this lattice, so rounding cannot split a face's colors.
    let cell = (p / PATCH).floor();
    let (x, y, z) = (cell.x as i64, cell.y as i64, cell.z as i64);
    let side = if normal.z.abs() > 0.9 { 11 } else { 5 };
    let pick = lattice(x + 31 * z, y - 17 * z, side);
    let color = PALETTE[((pick * 6.0) as usize).min(5)];
    let weave = 0.8 + 0.4 * noise(p * 45.0);
    color * weave
}

fn mix(a: DVec3, b: DVec3, share: f64) -> DVec3 {
    a + (b - a) * share
}

fn smooth(low: f64, high: f64, x: f64) -> f64 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// A hash of three integers, in [0, 1).
fn lattice(x: i64, y: i64, z: i64) -> f64 {
    let mut bits = (x as u64)
        .wrapping_mul(0x9e37_79b9_7f4a_7c15)
        .wrapping_add((y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f))
        .wrapping_add((z as u64).wrapping_mul(0x1656_67b1_9e37_79f9));
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((bits ^ (bits >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

/// Smooth value noise in [0, 1) with features of about one unit.
fn noise(p: DVec3) -> f64 {
    let cell = p.floor();
    let (x, y, z) = (cell.x as i64, cell.y as i64, cell.z as i64);
    let t = p - cell;
    let t = t * t * (DVec3::splat(3.0) - 2.0 * t);
    let edge = |dy: i64, dz: i64| {
        let (a, b) = (lattice(x, y + dy, z + dz), lattice(x + 1, y + dy, z + dz));
        a + (b - a) * t.x
    };
    let (near, far) =
        (edge(0, 0) + (edge(1, 0) - edge(0, 0)) * t.y, edge(0, 1) + (edge(1, 1) - edge(0, 1)) * t.y);
    near + (far - near) * t.z
}

/// Noise over several octaves, in [0, 1).
fn fbm(p: DVec3, octaves: u32) -> f64 {
    let (mut sum, mut weight, mut scale) = (0.0, 0.5, 1.0);
    let mut total = 0.0;
    for _ in 0..octaves {
        sum += weight * noise(p * scale);
        total += weight;
        weight *= 0.5;
        scale *= 2.03;
    }
    sum / total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_and_stays_in_its_range() {
        let mut previous = noise(DVec3::new(-3.0, 0.4, 0.7));
        for step in 1..6000 {
            let value = noise(DVec3::new(-3.0 + f64::from(step) * 1e-3, 0.4, 0.7));
            assert!((0.0..1.0).contains(&value));
            assert!((value - previous).abs() < 2e-3, "a jump at step {step}");
            previous = value;
        }
    }

    #[test]
    fn colors_are_possible_albedos() {
        let all = [
            Texture::Tiles,
            Texture::Sky,
            Texture::Lacquer,
            Texture::Patchwork,
            Texture::Bands,
            Texture::Helix,
            Texture::Plain(DVec3::splat(0.5)),
        ];
        for texture in all {
            for step in 0..2000 {
                let t = f64::from(step) * 0.01;
                let p = DVec3::new(sin(t) * 3.0, sin(1.7 * t) * 3.0, sin(0.3 * t).abs());
                let color = texture.albedo(p, DVec3::Z);
                assert!(color.min_element() >= 0.0 && color.max_element() <= 1.0, "{texture:?}: {color}");
            }
        }
    }
}
