//! The gradient of rendering by offset masks.

use super::logistic::logistic;
use crate::render::twin::{Gaussian, GaussianGradient};

/// Adds the rendering loss's straight-through gradient by one anchor's logits. `gaussians` are the anchor's; an offset
/// without one gets nothing.
pub fn mask_gradient(
    logits: &[f64],
    gaussians: &[Option<Gaussian>],
    d_gaussians: &[GaussianGradient],
    d_logits: &mut [f64],
) {
    for (((logit, gaussian), d), d_logit) in logits.iter().zip(gaussians).zip(d_gaussians).zip(d_logits) {
        if let Some(gaussian) = gaussian {
            *d_logit += d.opacity * gaussian.opacity * logistic(*logit) * (1.0 - logistic(*logit));
        }
    }
}
