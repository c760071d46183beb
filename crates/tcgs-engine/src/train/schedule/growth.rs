//! The screen gradient from which anchors grow (METHOD.md §2.7).
//!
//! Invariant: no threshold is below the published one.

/// The published threshold, also that of the baseline.
pub(super) const PUBLISHED: f32 = 2e-4;

/// The threshold at [`REFERENCE_LAMBDA`].
const AT_REFERENCE: f64 = 4e-4;
const REFERENCE_LAMBDA: f64 = 5e-4;

/// The threshold at a weight of the rate. An anchor at a place with a gradient of g lowers the loss by about g² over the curvature,
/// and costs its bits, about the same everywhere: growth pays from a gradient that grows with the root of their weight.
pub(super) fn threshold(lambda: f64) -> f32 {
    let threshold = AT_REFERENCE * (lambda / REFERENCE_LAMBDA).sqrt();
    (threshold as f32).max(PUBLISHED)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn growth_asks_for_more_where_bits_weigh_more_and_never_for_less_than_published() {
        assert!((threshold(REFERENCE_LAMBDA) - 4e-4).abs() < 1e-9);
        assert!((threshold(4.0 * REFERENCE_LAMBDA) - 8e-4).abs() < 1e-9);
        assert_eq!([0.0, 1e-9, REFERENCE_LAMBDA / 5.0].map(threshold), [PUBLISHED; 3]);
        assert_eq!(threshold(f64::MAX), f32::INFINITY, "nothing grows");
    }
}
