//! The projection of a camera and the rasteriser's settings, in f64 for the twins and packed for the kernels.

use glam::{DMat3, DVec2, DVec3, UVec2};

use crate::domain::{Camera, NearPlane};

/// Side of a tile in pixels.
pub const TILE: u32 = 16;

/// How the rasteriser treats Gaussians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RasterSettings {
    /// Gaussians whose centre is at this depth or nearer are culled, in world units.
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
    /// Depth that a Gaussian's centre must exceed.
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

/// `View` of `shaders/shared/view.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct View {
    rows: [[f32; 4]; 3],
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
    pub(super) fn new(
        projection: &Projection,
        background: [f32; 3],
        gaussians: usize,
        intersections: usize,
    ) -> Self {
        let (slope_low, slope_high) = projection.slopes();
        let rows = [0, 1, 2]
            .map(|i| projection.rotation.row(i).extend(projection.translation[i]).as_vec4().to_array());
        Self {
            rows,
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
            gaussian_capacity: u32::try_from(gaussians).unwrap_or(u32::MAX),
            intersection_capacity: u32::try_from(intersections).unwrap_or(u32::MAX),
            unused: [0; 3],
        }
    }
}
