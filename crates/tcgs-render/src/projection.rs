//! The projection of a camera and the rasterizer's settings, in f64 for the twins and packed for the kernels.

use glam::{DMat3, DVec2, DVec3, UVec2};

use super::Gaussians;
use crate::domain::{Camera, NearPlane};

/// Side of a tile in pixels.
pub const TILE: u32 = 16;

/// How the rasterizer treats Gaussians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RasterSettings {
    /// Gaussians whose center is at this depth or nearer are culled, in world units.
    pub near: f32,
    /// Whether opacities compensate for the area that the low-pass filter adds (Mip-Splatting).
    pub antialiased: bool,
    /// Variance added to both axes of the projected covariance, in square pixels.
    pub low_pass: f32,
}

impl Default for RasterSettings {
    fn default() -> Self {
        Self { near: NearPlane::DEFAULT.depth(), antialiased: false, low_pass: 0.3 }
    }
}

/// A camera as the projection uses it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    /// World to camera.
    pub rotation: DMat3,
    /// World to camera.
    pub translation: DVec3,
    /// Focal lengths in pixels.
    pub focal: DVec2,
    /// Principal point in pixels.
    pub center: DVec2,
    /// Width and height in pixels.
    pub size: UVec2,
    /// Depth that a Gaussian's center must exceed.
    pub near: f64,
    /// Variance added to both axes.
    pub low_pass: f64,
    /// Whether opacities are compensated for the low-pass filter.
    pub antialiased: bool,
}

impl Projection {
    /// The projection of `camera`.
    #[must_use]
    pub fn new(camera: &Camera, settings: &RasterSettings) -> Self {
        let k = &camera.intrinsics;
        Self {
            rotation: camera.pose.rotation(),
            translation: camera.pose.translation(),
            focal: DVec2::new(k.fx, k.fy),
            center: DVec2::new(k.cx, k.cy),
            size: UVec2::new(k.width, k.height),
            near: f64::from(settings.near),
            low_pass: f64::from(settings.low_pass),
            antialiased: settings.antialiased,
        }
    }

    /// Bounds of x/z and y/z inside the Jacobian: the image's edges with a margin of three tenths of half its width
    /// (METHOD.md §3.1).
    #[must_use]
    pub fn slopes(&self) -> (DVec2, DVec2) {
        let size = self.size.as_dvec2();
        let margin = 0.3 * 0.5 * size / self.focal;
        (-(self.center / self.focal + margin), (size - self.center) / self.focal + margin)
    }

    /// Tiles across and down.
    #[must_use]
    pub fn tiles(&self) -> UVec2 {
        UVec2::new(self.size.x.div_ceil(TILE), self.size.y.div_ceil(TILE))
    }
}

/// A pose as kernels get it: camera coordinates are the rotation of the difference to `eye`, plus the image of `eye`. In f32
/// that has the accuracy of the difference, while a rotation and a translation have that of the distance to the world's origin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CenteredPose {
    /// The camera center in f32.
    pub(super) eye: [f32; 3],
    /// Rows of the world-to-camera rotation, each with a camera coordinate of `eye`: what its rounding leaves.
    pub(super) rows: [[f32; 4]; 3],
}

impl CenteredPose {
    /// The pose of world-to-camera `rotation` and `translation`.
    pub(super) fn new(rotation: DMat3, translation: DVec3) -> Self {
        let eye = (-(rotation.transpose() * translation)).as_vec3();
        let rest = rotation * eye.as_dvec3() + translation;
        let rows = [0, 1, 2].map(|i| rotation.row(i).extend(rest[i]).as_vec4().to_array());
        Self { eye: eye.to_array(), rows }
    }

    /// The pose of a camera.
    pub(super) fn of(camera: &Camera) -> Self {
        Self::new(camera.pose.rotation(), camera.pose.translation())
    }

    /// The center with a fourth number.
    pub(super) fn eye_and(&self, fourth: f32) -> [f32; 4] {
        let [x, y, z] = self.eye;
        [x, y, z, fourth]
    }

    /// The same pose for points relative to `origin`, a position of f32 at `eye` or at the world's origin: the difference is exact.
    pub(super) fn relative_to(self, origin: [f32; 3]) -> Self {
        Self { eye: [0, 1, 2].map(|axis| self.eye[axis] - origin[axis]), ..self }
    }
}

/// `View` of `shaders/shared/view.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct View {
    rows: [[f32; 4]; 3],
    eye: [f32; 4],
    background: [f32; 4],
    focal: [f32; 2],
    center: [f32; 2],
    slope_low: [f32; 2],
    slope_high: [f32; 2],
    size: [u32; 2],
    tiles: [u32; 2],
    near: f32,
    low_pass: f32,
    antialiased: u32,
    gaussian_capacity: u32,
    intersection_capacity: u32,
    unused: [u32; 3],
}

impl View {
    /// A view of nothing, for kernels that read only how many rows there are.
    pub(super) fn of_rows(gaussians: usize, intersections: usize) -> Self {
        Self {
            gaussian_capacity: u32::try_from(gaussians).unwrap_or(u32::MAX),
            intersection_capacity: u32::try_from(intersections).unwrap_or(u32::MAX),
            ..bytemuck::Zeroable::zeroed()
        }
    }

    pub(super) fn new(
        projection: &Projection,
        background: [f32; 3],
        gaussians: &Gaussians,
        intersections: usize,
    ) -> Self {
        let (slope_low, slope_high) = projection.slopes();
        let pose =
            CenteredPose::new(projection.rotation, projection.translation).relative_to(gaussians.origin);
        Self {
            rows: pose.rows,
            eye: pose.eye_and(0.0),
            background: [background[0], background[1], background[2], 0.0],
            focal: projection.focal.as_vec2().to_array(),
            center: projection.center.as_vec2().to_array(),
            slope_low: slope_low.as_vec2().to_array(),
            slope_high: slope_high.as_vec2().to_array(),
            size: projection.size.to_array(),
            tiles: projection.tiles().to_array(),
            near: projection.near as f32,
            low_pass: projection.low_pass as f32,
            antialiased: u32::from(projection.antialiased),
            gaussian_capacity: u32::try_from(gaussians.capacity).unwrap_or(u32::MAX),
            intersection_capacity: u32::try_from(intersections).unwrap_or(u32::MAX),
            unused: [0; 3],
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::domain::Pose;

    use super::*;

    /// As the kernels compute it.
    fn to_camera(pose: &CenteredPose, point: DVec3) -> DVec3 {
        let d: [f32; 3] = std::array::from_fn(|axis| point[axis] as f32 - pose.eye[axis]);
        DVec3::from(pose.rows.map(|[x, y, z, w]| f64::from(x * d[0] + y * d[1] + z * d[2] + w)))
    }

    #[test]
    fn camera_coordinates_are_as_accurate_far_from_the_origin_as_near_it() {
        for origin in [DVec3::ZERO, DVec3::new(1e5, -1e5, 1e5), DVec3::new(-1e7, 3e6, 0.0)] {
            let eye = origin + DVec3::new(3.0, -2.0, 1.7);
            let pose = Pose::look_at(eye, origin, DVec3::Z).expect("a view");
            let centered = CenteredPose::new(pose.rotation(), pose.translation());
            for offset in [DVec3::ZERO, DVec3::new(1.0, 1.0, -1.0), DVec3::new(-0.5, 0.25, 4.0)] {
                // Points that f32 has.
                let point = (origin + offset).as_vec3().as_dvec3();
                let truth = pose.rotation() * point + pose.translation();
                // The truth itself cancels 1e7 to an order of one.
                let bound = 1e-6 * truth.length() + 1e-15 * origin.length();
                let error = (to_camera(&centered, point) - truth).length();
                assert!(error < bound, "{origin} {offset}: {error:e}");
            }
        }
    }
}
