//! The sums of the losses of pixels.

/// A pixel's share of SSIM, absolute and squared difference, each summed over the channels.
pub type Losses = [f64; 3];

/// The sums over all pixels.
#[must_use]
pub fn sum_losses(losses: &[Losses]) -> Losses {
    losses.iter().fold([0.0; 3], |sums, pixel| [0, 1, 2].map(|part| sums[part] + pixel[part]))
}
