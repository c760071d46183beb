//! Gaussians, cameras and derivatives of images from seeds. All numbers are f32, so that the device sees the same.

use glam::{DMat3, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use tcgs_codec::domain::{Camera, Intrinsics, Pose};
use tcgs_render::twin::Gaussian;

/// The number that the device has.
pub(super) fn rounded(v: f64) -> f64 {
    f64::from(v as f32)
}

/// The Gaussian that the device has.
pub(super) fn on_device(g: &Gaussian) -> Gaussian {
    Gaussian {
        mean: g.mean.map(rounded),
        opacity: rounded(g.opacity),
        scale: g.scale.map(rounded),
        quat: g.quat.map(rounded),
        color: g.color.map(rounded),
    }
}

/// `count` Gaussians in the box [-1, 1]³ with standard deviations up to `size`.
pub(super) fn gaussians(seed: u64, count: usize, size: f64) -> Vec<Gaussian> {
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut three = |low: f64, high: f64| DVec3::from([0; 3].map(|_| rng.random_range(low..high)));
    let mut one = || Gaussian {
        mean: three(-1.0, 1.0),
        opacity: three(0.02, 0.98).x,
        scale: three(0.1 * size, size),
        quat: [three(0.1, 1.0).x, three(-1.0, 1.0).x, three(-1.0, 1.0).x, three(-1.0, 1.0).x],
        color: three(0.0, 1.0),
    };
    (0..count).map(|_| on_device(&one())).collect()
}

/// The same scene, `change`d and rounded to what the device has.
pub(super) fn changed(mut scene: Vec<Gaussian>, change: impl Fn(usize, &mut Gaussian)) -> Vec<Gaussian> {
    for (i, gaussian) in scene.iter_mut().enumerate() {
        change(i, gaussian);
        *gaussian = on_device(gaussian);
    }
    scene
}

fn intrinsics(width: u32, height: u32) -> Intrinsics {
    let side = f64::from(width.max(height));
    Intrinsics {
        fx: rounded(1.2 * side),
        fy: rounded(1.3 * side),
        cx: rounded(0.45 * f64::from(width)),
        cy: rounded(0.55 * f64::from(height)),
        width,
        height,
    }
}

/// A camera at distance 4 that looks at the box, off center, with unequal focal lengths.
pub(super) fn camera(width: u32, height: u32) -> Camera {
    camera_at(DVec3::new(3.0, -2.0, 1.7), DVec3::ZERO, width, height)
}

/// A camera at `eye` that looks at `target`.
pub(super) fn camera_at(eye: DVec3, target: DVec3, width: u32, height: u32) -> Camera {
    let pose = Pose::look_at(eye, target, DVec3::Z).expect("neither the same point nor vertical");
    Camera::new(intrinsics(width, height), pose).expect("a camera")
}

/// A camera at the origin that looks along z, x to the right and y down.
pub(super) fn forward_camera(width: u32, height: u32) -> Camera {
    let pose = Pose::from_world_to_camera(DMat3::IDENTITY, DVec3::ZERO).expect("rigid");
    Camera::new(intrinsics(width, height), pose).expect("a camera")
}

/// Random derivatives by an image of `pixels` pixels, from -1 to 1.
pub(super) fn d_image(seed: u64, pixels: usize) -> Vec<[f32; 4]> {
    let mut rng = Pcg64::seed_from_u64(seed);
    (0..pixels).map(|_| [0; 4].map(|_| rng.random_range(-1.0..1.0_f32))).collect()
}
