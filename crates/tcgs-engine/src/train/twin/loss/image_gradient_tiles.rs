//! The gradient of the image loss as the hardware divides the work.

use glam::{DVec3, USizeVec2};

use super::{SsimGradient, image_gradient, window::blur};

/// The gradient of [`image_gradient`](fn@super::image_gradient) from the derivatives of [`ssim_tiles`](fn@super::ssim_tiles).
#[must_use]
pub fn image_gradient_tiles(
    size: USizeVec2,
    render: &[DVec3],
    photograph: &[DVec3],
    derivatives: &[SsimGradient],
    weights: [f64; 2],
) -> Vec<DVec3> {
    image_gradient(size, render, photograph, &blur(size, 1, derivatives), weights).0
}
