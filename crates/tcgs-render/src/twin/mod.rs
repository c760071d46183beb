//! The renderer on the CPU in f64: every kernel has a function of the same name here. Kernels are tested against these, and these
//! against independent values and central differences.

mod dense;
pub mod neural;
mod picture;
pub mod plain;
mod raster;

use glam::{DVec2, DVec3};

pub use picture::{pack_image, shade_depth};
pub use raster::{
    BlendedImage, TileLists, clear_culled, compact, emit, gather, project, project_backward, raster_backward,
    raster_forward, removal_loss, rotation, tile_counts, tile_lists, tile_ranges, touches,
};

use super::Projection;

/// Largest opacity that a Gaussian has in a pixel.
pub const ALPHA_MAX: f64 = 0.99;

/// One Gaussian.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaussian {
    /// World position.
    pub mean: DVec3,
    /// Linear opacity.
    pub opacity: f64,
    /// Standard deviations along its axes.
    pub scale: DVec3,
    /// Rotation w, x, y, z, of any length.
    pub quat: [f64; 4],
    /// Red, green, blue.
    pub color: DVec3,
}

/// A Gaussian on the image plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Splat {
    /// Center in pixels.
    pub center: DVec2,
    /// Depth of the center.
    pub depth: f64,
    /// Opacity after the antialiasing compensation.
    pub opacity: f64,
    /// Inverse covariance A, B, C: power = (A dx² + C dy²) / 2 + B dx dy.
    pub conic: DVec3,
    /// Half width and height in pixels of the region above the cut-off.
    pub extent: DVec2,
    /// Power above which a pixel is cut off.
    pub level: f64,
    /// Red, green, blue.
    pub color: DVec3,
}

/// Gradients by a splat; B of the conic counted once.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SplatGradient {
    /// By the center in pixels.
    pub center: DVec2,
    /// By the effective opacity.
    pub opacity: f64,
    /// By A, B, C.
    pub conic: DVec3,
    /// By the color.
    pub color: DVec3,
}

/// Gradients by a Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GaussianGradient {
    /// By the position.
    pub mean: DVec3,
    /// By the opacity.
    pub opacity: f64,
    /// By the standard deviations.
    pub scale: DVec3,
    /// By the quaternion as given.
    pub quat: [f64; 4],
    /// By the color.
    pub color: DVec3,
}

/// Cut-offs of blending. The kernels use the default; finite differences disable them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cutoffs {
    /// Contributions below this opacity are skipped.
    pub alpha: f64,
    /// A Gaussian that would bring the transmittance here or below ends the pixel and is not added.
    pub transmittance: f64,
}

impl Cutoffs {
    /// Far below what an 8-bit or a 16-bit picture shows.
    pub const FINE: Self = Self { alpha: 1e-6, transmittance: 1e-9 };
}

impl Default for Cutoffs {
    fn default() -> Self {
        Self { alpha: 1.0 / 255.0, transmittance: 1e-4 }
    }
}

/// Everything that a forward pass computes.
#[derive(Debug, Clone)]
pub struct Rendering {
    /// One for each Gaussian; none where culled.
    pub splats: Vec<Option<Splat>>,
    /// The tiles' lists.
    pub lists: TileLists,
    /// The image.
    pub frame: BlendedImage,
}

/// The forward pass.
#[must_use]
pub fn forward(
    projection: &Projection,
    gaussians: &[Gaussian],
    background: DVec3,
    cutoffs: Cutoffs,
) -> Rendering {
    let mut splats: Vec<_> =
        gaussians.iter().map(|gaussian| project(projection, gaussian, cutoffs)).collect();
    let lists = tile_lists(projection, &splats);
    for (splat, tiles) in splats.iter_mut().zip(&lists.tiles) {
        if *tiles == 0 {
            *splat = None;
        }
    }
    let frame = raster_forward(projection, &splats, &lists, background, cutoffs);
    Rendering { splats, lists, frame }
}

/// The backward pass: gradients by the splats and by the Gaussians, from those by the image (red, green, blue, alpha).
#[must_use]
pub fn backward(
    projection: &Projection,
    gaussians: &[Gaussian],
    rendering: &Rendering,
    d_image: &[[f64; 4]],
    cutoffs: Cutoffs,
) -> (Vec<SplatGradient>, Vec<GaussianGradient>) {
    let slots = raster_backward(projection, rendering, d_image, cutoffs);
    let d_splats = gather(&rendering.lists, &slots);
    let d_gaussians = gaussians
        .iter()
        .zip(&rendering.splats)
        .zip(&d_splats)
        .map(|((gaussian, splat), v)| match splat {
            Some(_) => project_backward(projection, gaussian, v),
            None => clear_culled(),
        })
        .collect();
    (d_splats, d_gaussians)
}
