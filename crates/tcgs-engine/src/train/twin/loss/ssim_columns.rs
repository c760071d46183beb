//! The window of SSIM along columns, and SSIM.

use glam::USizeVec2;

use super::{Moments, SsimGradient, similarity::similarity, window::blur};

/// The second half, along columns; of each pixel's derivatives of SSIM the first half of the window's adjoint, along columns
/// too; and each pixel's SSIM, summed over the channels. The window is symmetric and zero-padded: its own adjoint.
#[must_use]
pub fn ssim_columns(size: USizeVec2, rows: &[Moments]) -> (Vec<SsimGradient>, Vec<f64>) {
    let (derivatives, ssim): (Vec<_>, Vec<_>) = blur(size, 1, rows).into_iter().map(similarity).unzip();
    (blur(size, 1, &derivatives), ssim)
}
