//! A layer between planes and latents, from fine to coarse.

use super::convolution::{from_bias, terms};
use crate::train::context::ConvSpec;

/// From fine to coarse. Without a bias it is the gradient of [`conv_up`](fn@super::conv_up) by its input.
#[must_use]
pub fn conv_down(spec: &ConvSpec, parameters: &[f64], bias: Option<usize>, source: &[f64]) -> Vec<f64> {
    let mut result = from_bias(parameters, bias, spec.coarse, spec.edge * spec.edge);
    terms(spec).for_each(|t| result[t.coarse] += parameters[spec.weights + t.weight] * source[t.fine]);
    result
}
