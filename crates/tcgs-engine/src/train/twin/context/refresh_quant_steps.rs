//! The steps of attribute groups.

use super::step_octaves::octaves_of;
use crate::{domain::AttributeGroup, train::context::Quantization};

/// The step of an attribute group for the adjustment `wanted` of its network.
#[must_use]
pub fn refresh_quant_steps(by: &Quantization, group: AttributeGroup, wanted: f64) -> f64 {
    f64::from(by.base_quant_steps[group as usize]) * octaves_of(by.phase, wanted).0.exp2()
}
