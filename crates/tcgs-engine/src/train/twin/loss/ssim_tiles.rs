//! SSIM as the hardware divides the work.

use glam::{DVec3, USizeVec2};

use super::{Losses, SsimGradient, similarity::similarity, ssim_rows, window::blur};

/// As the hardware divides the work: of each pixel the derivatives of SSIM, and its losses.
#[must_use]
pub fn ssim_tiles(
    size: USizeVec2,
    render: &[DVec3],
    photograph: &[DVec3],
) -> (Vec<SsimGradient>, Vec<Losses>) {
    let moments = blur(size, 1, &ssim_rows(size, render, photograph));
    let pixels = moments.into_iter().map(similarity).zip(render).zip(photograph);
    pixels
        .map(|(((derivatives, ssim), x), y)| {
            let difference = x - y;
            let losses = [ssim, difference.abs().element_sum(), (difference * difference).element_sum()];
            (derivatives, losses)
        })
        .unzip()
}
