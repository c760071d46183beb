//! Gaussians on the device and their gradients: rows of four floats.
//!
//! A WebGPU kernel may bind eight storage buffers, so the geometry of Gaussians is one buffer of three sections of `capacity` rows
//! (`shaders/shared/geometry.wgsl`).

use crate::gpu::{Buffer, Plan, planned};

/// Sections of a geometry buffer: position and opacity, scales, quaternion.
pub const GEOMETRY_SECTIONS: usize = 3;

/// Gaussians on the device; the first `count[0]` of `capacity` rows are candidates.
#[derive(Debug, Clone)]
pub struct Gaussians {
    /// Rows in use, in element 0; clamped to `capacity`.
    pub count: Buffer<u32>,
    /// Rows of the colors and of every section of the geometry.
    pub capacity: usize,
    /// World position that the rows' positions are relative to. Near a camera that is far from the world's origin, f32 has positions
    /// relative to the camera far more accurately than the world's.
    pub origin: [f32; 3],
    /// `[3][capacity]`: position, and opacity (linear; below 1/255 is culled); then standard deviations along the axes, in
    /// world units, the fourth unused; then rotation w, x, y, z, of any length but zero (zero is culled).
    pub geometry: Buffer<[f32; 4]>,
    /// Red, green, blue as blended; the fourth is unused.
    pub colors: Buffer<[f32; 4]>,
}

impl Gaussians {
    /// Plans `capacity` Gaussians, all zero, none used, with a count buffer of `counts` elements.
    #[must_use]
    pub fn plan(capacity: usize, counts: usize) -> Plan<'static, Self> {
        planned!(Self {
            count: Plan::buffer("gaussian count", counts),
            capacity: Plan::value(capacity),
            origin: Plan::value([0.0; 3]),
            geometry: Plan::buffer("geometry", GEOMETRY_SECTIONS * capacity),
            colors: Plan::buffer("colors", capacity),
        })
    }
}

/// The loss's gradients, in the layouts of [`Gaussians`]; zero where a Gaussian is culled. Rows beyond the count are never
/// written.
#[derive(Debug, Clone)]
pub struct GaussianGradients {
    /// By position and opacity, by the standard deviations, and by the quaternion as given, before it is normalized.
    pub geometry: Buffer<[f32; 4]>,
    /// By the color.
    pub colors: Buffer<[f32; 4]>,
    /// By the projected center in pixels (u, v), then the number of tiles touched (0 = culled) and the radius: three
    /// standard deviations in pixels along the longer axis.
    pub means2d: Buffer<[f32; 4]>,
}

impl GaussianGradients {
    /// Plans the gradients of `capacity` Gaussians.
    #[must_use]
    pub fn plan(capacity: usize) -> Plan<'static, Self> {
        planned!(Self {
            geometry: Plan::buffer("gradients of geometry", GEOMETRY_SECTIONS * capacity),
            colors: Plan::buffer("gradients of colors", capacity),
            means2d: Plan::buffer("gradients of projected centers", capacity),
        })
    }
}
