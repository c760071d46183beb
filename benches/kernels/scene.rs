//! The synthetic scene: what a trained object looks like to the kernels.
//!
//! Gaussians lie on a shell, as on a surface: flat (a fifth as thick as wide), turned at random, about as wide as the
//! distance to their neighbors, so that a few overlap at every point and the intersections of each with tiles are as
//! many as in a trained scene of that number. The camera sees the whole shell and it fills most of the image. Half of
//! the Gaussians face away and are hidden, as in a scene, but no less sorted and listed.

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::{Camera, Intrinsics, Pose},
    gpu::Device,
    init::{VoxelRule, initial_rows, random_points},
    model::{AnchorRows, ModelShape},
    render::Gaussians,
};

/// Widths of the anchors, as the preview preset trains them.
pub(crate) const SHAPE: ModelShape = ModelShape::new(32, 10);

/// A square view from outside the shell.
pub(crate) fn camera(side: u32) -> Camera {
    let pose = Pose::look_at(DVec3::new(3.0, 1.0, 1.5), DVec3::ZERO, DVec3::Z).unwrap();
    Camera::new(Intrinsics::from_horizontal_fov(0.7, side, side).unwrap(), pose).unwrap()
}

/// `count` Gaussians on a shell of radius one.
pub(crate) fn shell(device: &Device, count: usize) -> Gaussians {
    let mut rng = Pcg64::seed_from_u64(1);
    // Side of the square that each would have of the sphere's surface.
    let spacing = (4.0 * std::f32::consts::PI / count as f32).sqrt();
    let (mut means, mut scales, mut quats, mut colors) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    while means.len() < count {
        let at = glam::Vec3::from_array([0; 3].map(|_| rng.random_range(-1.0..1.0_f32)));
        if !(0.01..1.0).contains(&at.length_squared()) {
            continue;
        }
        let at = at.normalize() * rng.random_range(0.97..1.0);
        means.push([at.x, at.y, at.z, rng.random_range(0.05..1.0)]);
        let width = spacing * rng.random_range(0.3..0.9);
        scales.push([width, width * rng.random_range(0.4..1.0), 0.2 * width, 0.0]);
        quats.push([0; 4].map(|_| rng.random_range(-1.0..1.0)));
        colors.push([0; 4].map(|_| rng.random_range(0.0..1.0)));
    }
    Gaussians {
        count: device.upload("count", &[count as u32]).unwrap(),
        capacity: count,
        origin: [0.0; 3],
        geometry: device.upload("geometry", &[means, scales, quats].concat()).unwrap(),
        colors: device.upload("colors", &colors).unwrap(),
    }
}

/// About `count` anchors, all of which the camera sees, with features as if they had been trained.
pub(crate) fn anchors(rng: &mut Pcg64, count: usize) -> AnchorRows {
    let points = random_points(rng, count, [-0.7; 3], [0.7; 3]);
    let mut rows = initial_rows(&points, VoxelRule::OfSpacing(1.0 / 16.0), SHAPE, usize::MAX).unwrap();
    for row in rows.values.chunks_exact_mut(SHAPE.row()) {
        row[..SHAPE.features].fill_with(|| rng.random_range(-1.0..1.0));
        row[SHAPE.offset_column()..].fill_with(|| rng.random_range(-1.0..1.0));
    }
    rows
}
