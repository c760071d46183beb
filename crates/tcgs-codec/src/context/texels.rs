//! The three planes as they are sampled: four texels and bilinear weights in 2^-8 for a coordinate on each.

use super::COORDINATE_LIMIT;
use crate::domain::context_model::PLANE_AXES;

/// Planes of a scene.
pub(crate) const PLANES: usize = PLANE_AXES.len();

/// Most texels along the edge of a plane.
pub(crate) const MAX_PLANE_EDGE: usize = 1024;

/// A place on a plane, between four texels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Texel {
    /// Column of the texels towards zero.
    pub x0: u32,
    /// Column of the others; `x0` again at the rim.
    pub x1: u32,
    /// Weight of column `x1`, in 2^-8, below 256.
    pub fx: u32,
    /// Row of the texels towards zero.
    pub y0: u32,
    /// Row of the others; `y0` again at the rim.
    pub y1: u32,
    /// Weight of row `y1`, in 2^-8, below 256.
    pub fy: u32,
}

/// The place of a coordinate on each of [`PLANE_AXES`], on planes of `plane_edge` texels: the first texel's center is at
/// -2, the last one's at 2. Coordinates beyond count as those, and edges beyond 1 to 1024 as the nearest of these.
#[must_use]
pub fn texels(coordinate: [i32; 3], plane_edge: usize) -> [Texel; 3] {
    let last = plane_edge.clamp(1, MAX_PLANE_EDGE) as u32 - 1;
    let along = |axis: usize| {
        let v = coordinate[axis].clamp(-COORDINATE_LIMIT, COORDINATE_LIMIT);
        // At most 2^18 x 1023, which fits.
        let place = ((v + COORDINATE_LIMIT) as u32 * last) >> 10;
        let whole = place >> 8;
        (whole, (whole + 1).min(last), place & 255)
    };
    PLANE_AXES.map(|[first, second]| {
        let ((x0, x1, fx), (y0, y1, fy)) = (along(first), along(second));
        Texel { x0, x1, fx, y0, y1, fy }
    })
}

/// Planes in the layout for sampling, channels last.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct PlaneTexels {
    pub(super) edge: usize,
    pub(super) channels: usize,
    /// `[3][edge][edge][channels]`.
    pub(super) values: Vec<i16>,
}

impl PlaneTexels {
    /// Texels along an edge.
    pub(crate) fn edge(&self) -> usize {
        self.edge
    }

    /// Values of a sample: the three planes' channels in turn.
    pub(crate) fn sample_width(&self) -> usize {
        PLANES * self.channels
    }

    /// Samples the planes at `places` into `sample`, of [`PlaneTexels::sample_width`] values.
    pub(crate) fn sample(&self, places: &[Texel; 3], sample: &mut [i16]) {
        let size = self.edge * self.edge * self.channels;
        for ((texel, plane), sample) in
            places.iter().zip(self.values.chunks(size)).zip(sample.chunks_mut(self.channels))
        {
            let at = |x: u32, y: u32| {
                let start = (y as usize * self.edge + x as usize) * self.channels;
                &plane[start..start + self.channels]
            };
            let [low, high] = [256 - texel.fx as i32, texel.fx as i32];
            let [near, far] = [256 - texel.fy as i32, texel.fy as i32];
            let corners = [
                (at(texel.x0, texel.y0), low * near),
                (at(texel.x1, texel.y0), high * near),
                (at(texel.x0, texel.y1), low * far),
                (at(texel.x1, texel.y1), high * far),
            ];
            for (channel, value) in sample.iter_mut().enumerate() {
                // Weights add up to 2^16, so the sum is below 2^30.
                let sum: i32 = corners.iter().map(|(texel, weight)| i32::from(texel[channel]) * weight).sum();
                *value = (sum >> 16) as i16;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_are_the_outermost_texels_and_the_middle_is_between() {
        let [xy, yz, xz] = texels([-COORDINATE_LIMIT, COORDINATE_LIMIT, 0], 16);
        let (low, high, middle) = ((0, 1, 0), (15, 15, 0), (7, 8, 128));
        let columns = |t: Texel| (t.x0, t.x1, t.fx);
        let rows = |t: Texel| (t.y0, t.y1, t.fy);
        assert_eq!((columns(xy), rows(xy)), (low, high));
        assert_eq!((columns(yz), rows(yz)), (high, middle));
        assert_eq!((columns(xz), rows(xz)), (low, middle));
    }

    #[test]
    fn texels_and_weights_stay_in_range() {
        for edge in [0, 1, 2, 3, 64, MAX_PLANE_EDGE, usize::MAX] {
            let last = edge.clamp(1, MAX_PLANE_EDGE) as u32 - 1;
            for v in (-COORDINATE_LIMIT..=COORDINATE_LIMIT).step_by(1009).chain([i32::MIN, i32::MAX]) {
                for texel in texels([v, v / 2, -(v / 2)], edge) {
                    assert!(texel.x0 <= texel.x1 && texel.x1 <= last && texel.fx < 256);
                    assert!(texel.y0 <= texel.y1 && texel.y1 <= last && texel.fy < 256);
                    assert!(texel.fx == 0 || texel.x1 == texel.x0 + 1);
                }
            }
        }
    }

    #[test]
    fn places_are_within_a_256th_of_the_exact_one() {
        for edge in [2_usize, 7, 32] {
            for v in (-COORDINATE_LIMIT..=COORDINATE_LIMIT).step_by(811) {
                let exact = (f64::from(v) / 65536.0 + 2.0) / 4.0 * (edge - 1) as f64;
                let texel = texels([v, 0, 0], edge)[0];
                let place = f64::from(texel.x0) + f64::from(texel.fx) / 256.0;
                assert!((0.0..1.0 / 256.0 + 1e-12).contains(&(exact - place)), "{place} for {exact}");
            }
        }
    }
}
