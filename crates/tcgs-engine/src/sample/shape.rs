//! The solids: ray intersection, surface normals, and points spread evenly over the surface.
//!
//! Rays have unit directions, normals are unit vectors that point out of the solid, lengths are world units.

use glam::{DVec2, DVec3};
use libm::{cos, sin};
use rand::{Rng, RngExt};

/// Nearest distance that counts, so that a ray leaving a surface does not meet that surface again.
pub(super) const MIN_DISTANCE: f64 = 1e-5;

/// A half line.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    pub(super) origin: DVec3,
    /// Unit length.
    pub(super) direction: DVec3,
}

impl Ray {
    pub(super) fn at(&self, distance: f64) -> DVec3 {
        self.origin + self.direction * distance
    }
}

/// A solid's form and place.
#[derive(Debug, Clone, Copy)]
pub(super) enum SampleShape {
    /// The plane z = 0, out to `radius` from the origin.
    Ground { radius: f64 },
    /// The inside of a sphere around the origin.
    Dome { radius: f64 },
    /// A ball.
    Sphere { center: DVec3, radius: f64 },
    /// A box turned about its vertical axis; `axis` is the direction of its x side in the ground plane.
    Block { center: DVec3, half: DVec3, axis: DVec2 },
    /// An upright cylinder with both ends closed.
    Cylinder { base: DVec3, radius: f64, height: f64 },
    /// A ring whose axis is vertical.
    Torus { center: DVec3, major: f64, minor: f64 },
    /// A straight rod with round ends.
    Rod { from: DVec3, to: DVec3, radius: f64 },
}

impl SampleShape {
    /// A ball that holds the whole solid; `None` for what surrounds the scene.
    pub(super) fn bound(&self) -> Option<(DVec3, f64)> {
        match *self {
            SampleShape::Ground { .. } | SampleShape::Dome { .. } => None,
            SampleShape::Sphere { center, radius } => Some((center, radius)),
            SampleShape::Block { center, half, .. } => Some((center, half.length())),
            SampleShape::Cylinder { base, radius, height } => {
                Some((base + DVec3::Z * (height / 2.0), DVec2::new(radius, height / 2.0).length()))
            }
            SampleShape::Torus { center, major, minor } => Some((center, major + minor)),
            SampleShape::Rod { from, to, radius } => {
                Some(((from + to) / 2.0, from.distance(to) / 2.0 + radius))
            }
        }
    }

    /// The first distance beyond [`MIN_DISTANCE`] at which the ray meets the surface.
    pub(super) fn intersect(&self, ray: &Ray) -> Option<f64> {
        match *self {
            SampleShape::Ground { radius } => {
                let distance = -ray.origin.z / ray.direction.z;
                let inside = ray.at(distance).truncate().length_squared() < radius * radius;
                (distance.is_finite() && distance > MIN_DISTANCE && inside).then_some(distance)
            }
            SampleShape::Dome { radius } => {
                ball(ray, DVec3::ZERO, radius).map(|(_, far)| far).filter(|far| *far > MIN_DISTANCE)
            }
            SampleShape::Sphere { center, radius } => {
                let (near, far) = ball(ray, center, radius)?;
                first([near, far])
            }
            SampleShape::Block { center, half, axis } => {
                let origin = into_frame(ray.origin - center, axis);
                let direction = into_frame(ray.direction, axis);
                let to_center = -origin / direction;
                let reach = (half / direction).abs();
                let enter = (to_center - reach).max_element();
                let leave = (to_center + reach).min_element();
                if enter > leave { None } else { first([enter, leave]) }
            }
            SampleShape::Cylinder { base, radius, height } => cylinder(ray, base, radius, height),
            SampleShape::Torus { center, major, minor } => torus(ray, center, major, minor),
            SampleShape::Rod { from, to, radius } => rod(ray, from, to, radius),
        }
    }

    /// The outward normal at a point of the surface.
    pub(super) fn normal(&self, point: DVec3) -> DVec3 {
        match *self {
            SampleShape::Ground { .. } => DVec3::Z,
            SampleShape::Dome { .. } => -point.normalize_or_zero(),
            SampleShape::Sphere { center, .. } => (point - center).normalize_or_zero(),
            SampleShape::Block { center, half, axis } => {
                let local = into_frame(point - center, axis);
                let depth = local.abs() / half;
                let face = if depth.z >= depth.x && depth.z >= depth.y {
                    DVec3::Z * local.z.signum()
                } else if depth.x >= depth.y {
                    DVec3::X * local.x.signum()
                } else {
                    DVec3::Y * local.y.signum()
                };
                out_of_frame(face, axis)
            }
            SampleShape::Cylinder { base, radius, height } => {
                let local = point - base;
                let side = local.truncate();
                if side.length() < radius * (1.0 - 1e-6) {
                    if local.z > height / 2.0 { DVec3::Z } else { -DVec3::Z }
                } else {
                    side.extend(0.0).normalize_or_zero()
                }
            }
            SampleShape::Torus { center, major, .. } => {
                let local = point - center;
                let ring = local.truncate().normalize_or_zero() * major;
                (local - ring.extend(0.0)).normalize_or_zero()
            }
            SampleShape::Rod { from, to, .. } => {
                let along = to - from;
                let share = ((point - from).dot(along) / along.length_squared()).clamp(0.0, 1.0);
                (point - (from + along * share)).normalize_or_zero()
            }
        }
    }

    /// The point in the solid's own frame, for textures that are fixed to it.
    pub(super) fn local(&self, point: DVec3) -> DVec3 {
        match *self {
            SampleShape::Ground { .. } | SampleShape::Dome { .. } => point,
            SampleShape::Sphere { center, .. } | SampleShape::Torus { center, .. } => point - center,
            SampleShape::Block { center, axis, .. } => into_frame(point - center, axis),
            SampleShape::Cylinder { base, .. } => point - base,
            SampleShape::Rod { from, .. } => point - from,
        }
    }

    /// A random point of the surface, evenly spread (over the ground: denser towards the middle, where cameras
    /// look; over the dome: its upper half).
    pub(super) fn surface_point(&self, rng: &mut impl Rng) -> DVec3 {
        let turn = rng.random::<f64>() * std::f64::consts::TAU;
        let around = DVec3::new(cos(turn), sin(turn), 0.0);
        let share = rng.random::<f64>();
        match *self {
            SampleShape::Ground { radius } => around * (radius * share),
            SampleShape::Dome { radius } => {
                (around * (1.0 - share * share).sqrt() + DVec3::Z * share) * radius
            }
            SampleShape::Sphere { center, radius } => {
                let height = 2.0 * share - 1.0;
                center + (around * (1.0 - height * height).sqrt() + DVec3::Z * height) * radius
            }
            SampleShape::Block { center, half, axis } => {
                let areas = [half.y * half.z, half.x * half.z, half.x * half.y];
                let mut pick = share * areas.iter().sum::<f64>();
                let mut face = 0;
                while face < 2 && pick > areas[face] {
                    pick -= areas[face];
                    face += 1;
                }
                let mut local = DVec3::from_array(std::array::from_fn(|_| 2.0 * rng.random::<f64>() - 1.0));
                local[face] = local[face].signum();
                center + out_of_frame(local * half, axis)
            }
            SampleShape::Cylinder { base, radius, height } => {
                let side = 2.0 * height / (2.0 * height + radius);
                if share < side {
                    base + around * radius + DVec3::Z * (height * share / side)
                } else {
                    let inner = ((share - side) / (1.0 - side)).sqrt() * radius;
                    base + around * inner + DVec3::Z * height
                }
            }
            SampleShape::Torus { center, major, minor } => {
                let tube = share * std::f64::consts::TAU;
                center + around * (major + minor * cos(tube)) + DVec3::Z * (minor * sin(tube))
            }
            SampleShape::Rod { from, to, radius } => {
                let along = (to - from).normalize_or_zero();
                let side = along.any_orthonormal_vector();
                from + (to - from) * share + (side * around.x + along.cross(side) * around.y) * radius
            }
        }
    }
}

fn first(distances: [f64; 2]) -> Option<f64> {
    distances.into_iter().find(|distance| *distance > MIN_DISTANCE)
}

/// Both distances at which a ray's line meets a ball.
pub(super) fn ball(ray: &Ray, center: DVec3, radius: f64) -> Option<(f64, f64)> {
    let offset = ray.origin - center;
    let half_b = offset.dot(ray.direction);
    let closest = offset - ray.direction * half_b;
    let under_root = radius * radius - closest.length_squared();
    (under_root >= 0.0).then(|| (-half_b - under_root.sqrt(), -half_b + under_root.sqrt()))
}

fn into_frame(v: DVec3, axis: DVec2) -> DVec3 {
    DVec3::new(v.x * axis.x + v.y * axis.y, v.y * axis.x - v.x * axis.y, v.z)
}

fn out_of_frame(v: DVec3, axis: DVec2) -> DVec3 {
    DVec3::new(v.x * axis.x - v.y * axis.y, v.x * axis.y + v.y * axis.x, v.z)
}

fn cylinder(ray: &Ray, base: DVec3, radius: f64, height: f64) -> Option<f64> {
    let origin = ray.origin - base;
    let (flat, step) = (origin.truncate(), ray.direction.truncate());
    let (a, half_b) = (step.length_squared(), flat.dot(step));
    let under_root = half_b * half_b - a * (flat.length_squared() - radius * radius);
    if under_root < 0.0 {
        return None;
    }
    let mut nearest = f64::INFINITY;
    for sign in [-1.0, 1.0] {
        let distance = (-half_b + sign * under_root.sqrt()) / a;
        let z = origin.z + ray.direction.z * distance;
        if distance > MIN_DISTANCE && (0.0..=height).contains(&z) {
            nearest = nearest.min(distance);
        }
    }
    for z in [0.0, height] {
        let distance = (z - origin.z) / ray.direction.z;
        let inside = (flat + step * distance).length_squared() <= radius * radius;
        if distance > MIN_DISTANCE && inside {
            nearest = nearest.min(distance);
        }
    }
    nearest.is_finite().then_some(nearest)
}

/// Sphere tracing: simpler and numerically steadier than the roots of a quartic.
fn torus(ray: &Ray, center: DVec3, major: f64, minor: f64) -> Option<f64> {
    let (near, far) = ball(ray, center, major + minor)?;
    let mut distance = near.max(MIN_DISTANCE);
    for _ in 0..512 {
        let local = ray.at(distance) - center;
        let ring = local.truncate().length() - major;
        let gap = DVec2::new(ring, local.z).length() - minor;
        if gap < 1e-6 && distance > 1e-3 {
            return Some(distance);
        }
        distance += gap.max(1e-5);
        if distance > far {
            return None;
        }
    }
    None
}

fn rod(ray: &Ray, from: DVec3, to: DVec3, radius: f64) -> Option<f64> {
    let along = to - from;
    let offset = ray.origin - from;
    let length_squared = along.length_squared();
    let (step, start) = (along.dot(ray.direction), along.dot(offset));
    let a = length_squared - step * step;
    let b = length_squared * ray.direction.dot(offset) - start * step;
    let c = length_squared * (offset.length_squared() - radius * radius) - start * start;
    let under_root = b * b - a * c;
    if under_root < 0.0 {
        return None;
    }
    let distance = (-b - under_root.sqrt()) / a;
    let share = start + distance * step;
    if share > 0.0 && share < length_squared {
        return (distance > MIN_DISTANCE).then_some(distance);
    }
    let end = if share <= 0.0 { from } else { to };
    let (near, _) = ball(ray, end, radius)?;
    (near > MIN_DISTANCE).then_some(near)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    use super::*;

    const SHAPES: [SampleShape; 5] = [
        SampleShape::Sphere { center: DVec3::new(0.2, -0.1, 0.5), radius: 0.5 },
        SampleShape::Block {
            center: DVec3::new(0.0, 0.3, 0.4),
            half: DVec3::new(0.3, 0.4, 0.5),
            axis: DVec2::new(0.8, 0.6),
        },
        SampleShape::Cylinder { base: DVec3::new(0.1, 0.0, 0.2), radius: 0.3, height: 0.9 },
        SampleShape::Torus { center: DVec3::new(0.0, 0.1, 0.3), major: 0.5, minor: 0.2 },
        SampleShape::Rod { from: DVec3::new(-0.4, 0.0, 0.1), to: DVec3::new(0.5, 0.3, 0.8), radius: 0.05 },
    ];

    #[test]
    fn a_ray_aimed_at_a_surface_point_from_outside_meets_it_or_something_nearer() {
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        for shape in SHAPES {
            let mut exact = 0;
            for _ in 0..400 {
                let target = shape.surface_point(&mut rng);
                let normal = shape.normal(target);
                assert!((normal.length() - 1.0).abs() < 1e-9, "{shape:?}");
                let origin = target + (normal + DVec3::new(0.2, 0.1, 0.15)) * 4.0;
                let ray = Ray { origin, direction: (target - origin).normalize() };
                let distance =
                    shape.intersect(&ray).unwrap_or_else(|| panic!("{shape:?} is not met at {target}"));
                assert!(distance < origin.distance(target) + 1e-4, "{shape:?}: stepped over the surface");
                exact += usize::from((distance - origin.distance(target)).abs() < 1e-4);
            }
            assert!(exact > 300, "{shape:?}: only {exact} of 400 points were met where they are");
        }
    }

    #[test]
    fn surface_points_lie_in_the_bound_and_rays_past_the_bound_miss() {
        let mut rng = Pcg64Mcg::seed_from_u64(4);
        for shape in SHAPES {
            let (center, radius) = shape.bound().expect("a bounded solid");
            for _ in 0..200 {
                assert!(shape.surface_point(&mut rng).distance(center) <= radius * (1.0 + 1e-9), "{shape:?}");
            }
            let origin = center + DVec3::new(5.0, radius * 1.01, 0.0);
            assert!(shape.intersect(&Ray { origin, direction: -DVec3::X }).is_none(), "{shape:?}");
            let behind = Ray { origin: center + DVec3::X * 5.0, direction: DVec3::X };
            assert!(shape.intersect(&behind).is_none(), "{shape:?} must not be met behind the eye");
        }
    }
}
