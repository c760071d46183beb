//! The sum of bits.

/// The sum of the sampled anchors' bits.
#[must_use]
pub fn sum_bits(bits: &[f64]) -> f64 {
    bits.iter().sum()
}
