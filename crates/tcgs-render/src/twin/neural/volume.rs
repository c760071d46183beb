//! The volume regularizer.

use crate::twin::Gaussian;

/// The volume regularizer: the mean product of the scales over the Gaussians (METHOD.md §2.4).
#[must_use]
pub fn volume(gaussians: &[Option<Gaussian>]) -> f64 {
    let count = gaussians.iter().flatten().count().max(1);
    gaussians.iter().flatten().map(|gaussian| gaussian.scale.element_product()).sum::<f64>() / count as f64
}
