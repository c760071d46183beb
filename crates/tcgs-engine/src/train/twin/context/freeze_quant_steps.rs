//! The frozen quantization steps of anchors.

/// The adjustment in octaves that gives `step`, and how far `predicted` is above it.
#[must_use]
pub fn freeze_quant_steps(predicted: f64, step: f64, base: f64) -> (f64, f64) {
    let frozen = (step / base).log2();
    (frozen, predicted - frozen)
}
