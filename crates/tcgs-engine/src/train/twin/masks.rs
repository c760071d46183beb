//! Offset masks (TC-GS II-C, METHOD.md §4.1): their loss, the gradients of rendering and bits by them, and their packing.

use crate::render::twin::{Gaussian, GaussianGradient};

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// The gradient of `weight` times the sum of the logits' logistics, by each logit.
#[must_use]
pub fn mask_loss(logits: &[f64], weight: f64) -> Vec<f64> {
    logits.iter().map(|logit| weight * logistic(*logit) * (1.0 - logistic(*logit))).collect()
}

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

/// Adds the gradient of `weight` times the bits of one anchor's offsets by its logits, each mask a factor of its offset's
/// bits.
pub fn mask_rate(logits: &[f64], bits: &[f64], weight: f64, d_logits: &mut [f64]) {
    for ((logit, bits), d_logit) in logits.iter().zip(bits).zip(d_logits) {
        *d_logit += weight * bits * logistic(*logit) * (1.0 - logistic(*logit));
    }
}

/// One anchor's binary mask: bit k is set where logit k is above `level`.
#[must_use]
pub fn mask_bits(logits: &[f32], level: f32) -> u32 {
    logits.iter().zip(0..).fold(0, |bits, (logit, k)| bits | (u32::from(*logit > level) << k))
}
