//! The gradients of culled Gaussians.

use crate::twin::GaussianGradient;

/// The gradient of a Gaussian that touches no tile: zero.
#[must_use]
pub fn clear_culled() -> GaussianGradient {
    GaussianGradient::default()
}
