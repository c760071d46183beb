//! Gaussians on the device and their gradients: plain columns of four floats, one row a Gaussian.

use crate::gpu::{Buffer, Context, GpuError, buffer_bytes};

/// Gaussians on the device; the first `count[0]` of `capacity` rows are candidates.
#[derive(Debug, Clone)]
pub struct Gaussians {
    /// How many rows are used, in element 0; more than `capacity` reads as `capacity`.
    pub count: Buffer<u32>,
    /// Rows of every column.
    pub capacity: usize,
    /// World position, and opacity (linear; below 1/255 is culled).
    pub means_opacity: Buffer<[f32; 4]>,
    /// Standard deviations along the axes, in world units; the fourth is unused.
    pub scales: Buffer<[f32; 4]>,
    /// Rotation w, x, y, z, of any length; one without length is culled.
    pub quats: Buffer<[f32; 4]>,
    /// Red, green, blue as blended; the fourth is unused.
    pub colors: Buffer<[f32; 4]>,
}

impl Gaussians {
    /// Bytes on the device.
    #[must_use]
    pub fn bytes(capacity: usize) -> u64 {
        buffer_bytes::<u32>(4) + 4 * buffer_bytes::<[f32; 4]>(capacity)
    }

    /// Bytes of the widest buffer.
    pub(super) fn widest_bytes(capacity: usize) -> u64 {
        buffer_bytes::<[f32; 4]>(capacity)
    }

    /// Room for `capacity` Gaussians, all zero, none used.
    ///
    /// # Errors
    /// As [`Context::buffer`].
    pub fn new(context: &Context, capacity: usize) -> Result<Self, GpuError> {
        Ok(Self {
            count: context.buffer("gaussian count", 1)?,
            capacity,
            means_opacity: context.buffer("means and opacities", capacity)?,
            scales: context.buffer("scales", capacity)?,
            quats: context.buffer("quaternions", capacity)?,
            colors: context.buffer("colours", capacity)?,
        })
    }
}

/// The loss's gradients, in the layouts of [`Gaussians`]; zero in every row that is culled or unused.
#[derive(Debug, Clone)]
pub struct GaussianGradients {
    /// By position and opacity.
    pub means_opacity: Buffer<[f32; 4]>,
    /// By the standard deviations.
    pub scales: Buffer<[f32; 4]>,
    /// By the quaternion as given, before it is normalised.
    pub quats: Buffer<[f32; 4]>,
    /// By the colour.
    pub colors: Buffer<[f32; 4]>,
    /// By the projected centre in pixels (u, v), then the number of tiles touched (0 = culled) and the radius: three
    /// standard deviations in pixels along the longer axis.
    pub means2d: Buffer<[f32; 4]>,
}

impl GaussianGradients {
    /// Bytes on the device.
    #[must_use]
    pub fn bytes(capacity: usize) -> u64 {
        5 * buffer_bytes::<[f32; 4]>(capacity)
    }

    /// Bytes of the widest buffer.
    pub(super) fn widest_bytes(capacity: usize) -> u64 {
        buffer_bytes::<[f32; 4]>(capacity)
    }

    /// Room for the gradients of `capacity` Gaussians.
    ///
    /// # Errors
    /// As [`Context::buffer`].
    pub fn new(context: &Context, capacity: usize) -> Result<Self, GpuError> {
        Ok(Self {
            means_opacity: context.buffer("gradients of means and opacities", capacity)?,
            scales: context.buffer("gradients of scales", capacity)?,
            quats: context.buffer("gradients of quaternions", capacity)?,
            colors: context.buffer("gradients of colours", capacity)?,
            means2d: context.buffer("gradients of projected centres", capacity)?,
        })
    }
}
