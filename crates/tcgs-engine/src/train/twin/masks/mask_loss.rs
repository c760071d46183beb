//! The gradient of the loss of offset masks.

use super::logistic::logistic;

/// The gradient of `weight` times the sum of the logits' logistics, by each logit.
#[must_use]
pub fn mask_loss(logits: &[f64], weight: f64) -> Vec<f64> {
    logits.iter().map(|logit| weight * logistic(*logit) * (1.0 - logistic(*logit))).collect()
}
