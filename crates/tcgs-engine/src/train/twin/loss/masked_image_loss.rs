//! The whole image loss of a photograph of which some pixels do not count.

use glam::{DVec3, USizeVec2};

use super::{Losses, image_gradient, similarity::similarity, ssim_rows, sum_losses, window::blur};

/// As [`image_loss`](super::image_loss()) over the pixels that `counts` names: the others are zero in both images, as outside of them,
/// and no window around them is compared. Means are over the samples that count; the gradient is that of the sums divided by all samples.
#[must_use]
pub fn masked_image_loss(
    size: USizeVec2,
    render: &[DVec3],
    photograph: &[DVec3],
    counts: &[bool],
) -> (Losses, Vec<DVec3>) {
    let of = |image: &[DVec3]| -> Vec<DVec3> {
        image.iter().zip(counts).map(|(pixel, counts)| if *counts { *pixel } else { DVec3::ZERO }).collect()
    };
    let (render, photograph) = (of(render), of(photograph));
    let samples = (3 * render.len()) as f64;
    let counted = 3.0 * counts.iter().filter(|counts| **counts).count() as f64;
    let moments = blur(size, 1, &ssim_rows(size, &render, &photograph)).into_iter().map(similarity);
    let (derivatives, ssim): (Vec<_>, Vec<_>) = moments
        .zip(counts)
        .map(
            |((derivatives, ssim), counts)| {
                if *counts { (derivatives, ssim) } else { ([DVec3::ZERO; 3], 0.0) }
            },
        )
        .unzip();
    let columns = blur(size, 1, &derivatives);
    let weights = [0.8 / samples, 0.2 / samples];
    let (gradient, differences) = image_gradient(size, &render, &photograph, &columns, weights);
    let losses: Vec<Losses> = ssim
        .iter()
        .zip(&differences)
        .map(|(ssim, [absolute, squared])| [*ssim, *absolute, *squared])
        .collect();
    (sum_losses(&losses).map(|sum| sum / counted), of(&gradient))
}
