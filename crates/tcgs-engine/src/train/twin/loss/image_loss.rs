//! The whole image loss.

use glam::{DVec3, USizeVec2};

use super::{Losses, image_gradient, ssim_columns, ssim_rows, sum_losses};

/// Mean SSIM, mean absolute and mean squared difference over all samples, and the gradient of 0.8 L1 + 0.2 (1 - SSIM).
#[must_use]
pub fn image_loss(size: USizeVec2, render: &[DVec3], photograph: &[DVec3]) -> (Losses, Vec<DVec3>) {
    let samples = (3 * render.len()) as f64;
    let rows = ssim_rows(size, render, photograph);
    let (columns, ssim) = ssim_columns(size, &rows);
    let (gradient, differences) =
        image_gradient(size, render, photograph, &columns, [0.8 / samples, 0.2 / samples]);
    let losses: Vec<Losses> = ssim
        .iter()
        .zip(&differences)
        .map(|(ssim, [absolute, squared])| [*ssim, *absolute, *squared])
        .collect();
    (sum_losses(&losses).map(|sum| sum / samples), gradient)
}
