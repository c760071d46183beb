//! The frozen quantisation steps of anchors.

/// The adjustment in octaves that gives `step`, and how far `predicted` is above it.
#[must_use]
pub fn freeze_quant_steps(predicted: f64, step: f64, base: f64) -> (f64, f64) {
    let frozen = (step / base).log2();
    (frozen, predicted - frozen)
}

/// The gradient of `weight` times half the squared difference by the prediction.
#[must_use]
pub fn frozen_quant_step_gradient(difference: f64, weight: f64) -> f64 {
    weight * difference
}
