//! Random scenes and cameras from a seed.

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs_codec::domain::{Camera, Intrinsics, Pose};
use tcgs_render::twin::Gaussian;

/// `count` Gaussians in the box [-1, 1]³ with standard deviations up to `size`.
pub fn gaussians(seed: u64, count: usize, size: f64) -> Vec<Gaussian> {
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut three = |low: f64, high: f64| DVec3::from([0; 3].map(|_| rng.random_range(low..high)));
    let rows: Vec<[DVec3; 5]> = (0..count)
        .map(|_| {
            [three(-1.0, 1.0), three(0.1 * size, size), three(-1.0, 1.0), three(0.0, 1.0), three(0.02, 1.0)]
        })
        .collect();
    rows.into_iter()
        .map(|[mean, scale, axis, color, other]| Gaussian {
            // Through f32, so that the device sees the same numbers.
            mean: mean.as_vec3().as_dvec3(),
            opacity: f64::from(other.x as f32),
            scale: scale.as_vec3().as_dvec3(),
            quat: [other.y, axis.x, axis.y, axis.z].map(|v| f64::from(v as f32)),
            color: color.as_vec3().as_dvec3(),
        })
        .collect()
}

/// A camera at distance 4 that looks at the box, off center, with unequal focal lengths.
pub fn camera(width: u32, height: u32) -> Camera {
    let side = f64::from(width.max(height));
    let intrinsics = Intrinsics {
        fx: 1.2 * side,
        fy: 1.3 * side,
        cx: 0.45 * f64::from(width),
        cy: 0.55 * f64::from(height),
        width,
        height,
    };
    let pose = Pose::look_at(DVec3::new(3.0, -2.0, 1.7), DVec3::ZERO, DVec3::Z).expect("a view");
    Camera::new(intrinsics, pose).expect("a camera")
}

/// Random derivatives by an image of `pixels` pixels.
pub fn d_image(seed: u64, pixels: usize) -> Vec<[f32; 4]> {
    let mut rng = Pcg64::seed_from_u64(seed);
    (0..pixels).map(|_| [0; 4].map(|_| rng.random_range(-1.0..1.0_f32))).collect()
}
