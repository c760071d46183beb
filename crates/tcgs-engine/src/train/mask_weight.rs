//! How the weight of the mask loss follows lambda, the weight of the rate term.
//!
//! A mask that is on costs bits, so it has to be worth more where bits cost more (METHOD.md §4.1).
//! Invariant: the weight never falls below the one at the preset's own lambda.

/// Largest factor of the mask loss's weight: the largest that was measured. Far larger ones would leave no Gaussians.
const MAX_FACTOR: f64 = 16.0;

/// The factor of the mask loss's weight: the ratio of lambda to the preset's own, at least 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaskWeightGrowth {
    /// The preset's own lambda.
    pub from: f64,
}

impl MaskWeightGrowth {
    pub(in crate::train) fn factor(self, lambda: f64) -> f64 {
        (lambda / self.from).clamp(1.0, MAX_FACTOR)
    }
}
