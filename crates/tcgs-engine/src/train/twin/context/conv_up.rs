//! A layer between planes and latents, from coarse to fine.

use super::convolution::{from_bias, terms};
use crate::train::context::ConvSpec;

/// From coarse to fine. Without a bias it is the gradient of [`conv_down`](fn@super::conv_down) by its input.
#[must_use]
pub fn conv_up(spec: &ConvSpec, parameters: &[f64], bias: Option<usize>, source: &[f64]) -> Vec<f64> {
    let mut result = from_bias(parameters, bias, spec.fine, 4 * spec.edge * spec.edge);
    terms(spec).for_each(|t| result[t.fine] += parameters[spec.weights + t.weight] * source[t.coarse]);
    result
}
