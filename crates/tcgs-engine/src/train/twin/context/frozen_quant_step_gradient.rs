//! What holds predictions to frozen quantization steps.

/// The gradient of `weight` times half the squared difference by the prediction.
#[must_use]
pub fn frozen_quant_step_gradient(difference: f64, weight: f64) -> f64 {
    weight * difference
}
