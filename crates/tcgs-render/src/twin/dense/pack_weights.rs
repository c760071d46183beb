//! The weights of a dense layer as `dense_software` reads them.

use super::weight::weight;
use crate::model::LayerSpec;

/// Weights by output and then input, padded with zeros to a multiple of four inputs.
#[must_use]
pub fn pack_weights(layer: &LayerSpec, parameters: &[f64]) -> Vec<Vec<f64>> {
    let padded = layer.inputs.next_multiple_of(4);
    let weight_or_zero = |output: usize, input: usize| {
        if input < layer.inputs { parameters[weight(layer, output, input)] } else { 0.0 }
    };
    (0..layer.outputs)
        .map(|output| (0..padded).map(|input| weight_or_zero(output, input)).collect())
        .collect()
}
