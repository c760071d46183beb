//! The gradient of the image loss.

use glam::{DVec3, USizeVec2};

use super::{SsimGradient, window::blur};

/// The gradient of `l1_weight |x - y| - ssim_weight SSIM`, summed over all samples, by each sample of the render; and each
/// pixel's absolute and squared difference, summed over the channels.
#[must_use]
pub fn image_gradient(
    size: USizeVec2,
    render: &[DVec3],
    photograph: &[DVec3],
    columns: &[SsimGradient],
    [l1_weight, ssim_weight]: [f64; 2],
) -> (Vec<DVec3>, Vec<[f64; 2]>) {
    let sign = |v: f64| if v == 0.0 { 0.0 } else { v.signum() };
    let pixels = blur(size, 0, columns).into_iter().zip(render).zip(photograph);
    pixels
        .map(|(([by_mean, by_square, by_product], x), y)| {
            let difference = x - y;
            let d_ssim = by_mean + 2.0 * x * by_square + y * by_product;
            let losses = [difference.abs().element_sum(), (difference * difference).element_sum()];
            (l1_weight * difference.map(sign) - ssim_weight * d_ssim, losses)
        })
        .unzip()
}
