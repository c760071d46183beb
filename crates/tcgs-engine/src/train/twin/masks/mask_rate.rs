//! The gradient of bits by offset masks.

use super::logistic::logistic;

/// Adds the gradient of `weight` times the bits of one anchor's offsets by its logits, each mask a factor of its offset's
/// bits.
pub fn mask_rate(logits: &[f64], bits: &[f64], weight: f64, d_logits: &mut [f64]) {
    for ((logit, bits), d_logit) in logits.iter().zip(bits).zip(d_logits) {
        *d_logit += weight * bits * logistic(*logit) * (1.0 - logistic(*logit));
    }
}
