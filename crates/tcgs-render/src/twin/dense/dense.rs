//! One dense layer.

use super::weight::weight;
use crate::model::LayerSpec;

/// The layer's part of the output column: `W x + b`, where `x` is the layer's part of the input column.
#[must_use]
pub fn dense(layer: &LayerSpec, parameters: &[f64], input: &[f64]) -> Vec<f64> {
    let x = &input[layer.input_row..][..layer.inputs];
    (0..layer.outputs)
        .map(|output| {
            let products =
                x.iter().enumerate().map(|(input, x)| parameters[weight(layer, output, input)] * x);
            products.sum::<f64>() + parameters[layer.bias + output]
        })
        .collect()
}
