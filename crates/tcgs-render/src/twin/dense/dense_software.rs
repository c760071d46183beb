//! One dense layer as software adapters compute it.

use crate::model::LayerSpec;

/// As [`dense`](fn@super::dense), from packed weights.
#[must_use]
pub fn dense_software(layer: &LayerSpec, packed: &[Vec<f64>], parameters: &[f64], input: &[f64]) -> Vec<f64> {
    let x = &input[layer.input_row..][..layer.inputs];
    let biases = &parameters[layer.bias..][..layer.outputs];
    let sum = |weights: &[f64]| x.iter().zip(weights).map(|(x, w)| x * w).sum::<f64>();
    packed.iter().zip(biases).map(|(weights, bias)| sum(weights) + bias).collect()
}
