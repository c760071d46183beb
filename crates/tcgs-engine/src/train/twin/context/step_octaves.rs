//! Steps in octaves of base steps, as the decoder counts them.

use crate::{domain::context_model::STEP_OCTAVES, train::context::QuantizationPhase};

/// Octaves from one coded standard deviation to the next, and from one step to the next.
pub(super) const SPACING: f64 = 7.0 / 32.0;

/// The multiple of the spacing that the decoder's integers make of octaves (`FORMAT.md`).
pub(super) fn spacings(octaves: f64) -> i64 {
    (((octaves * 256.0 + 0.5).floor() as i64) * 1170 + 32768) >> 16
}

/// Octaves of base steps that a group's step is for the adjustment `wanted`, and which multiple of the spacing when rounding.
pub(super) fn octaves_of(phase: QuantizationPhase, wanted: f64) -> (f64, i64) {
    let bounded = wanted.clamp(-f64::from(STEP_OCTAVES), f64::from(STEP_OCTAVES));
    let index = spacings(bounded).clamp(-16, 16);
    let octaves = if phase == QuantizationPhase::Rounded { index as f64 * SPACING } else { bounded };
    (octaves, index)
}
