//! The gradient by the input of a dense layer.

use super::weight::weight;
use crate::model::LayerSpec;

/// The transposed layer: writes `Wᵀ d_output` into the layer's part of the input column's gradient.
pub fn dense_input_gradient(layer: &LayerSpec, parameters: &[f64], d_output: &[f64], d_input: &mut [f64]) {
    let d_output = &d_output[layer.output_row..][..layer.outputs];
    for (input, d) in d_input[layer.input_row..][..layer.inputs].iter_mut().enumerate() {
        let products = d_output.iter().enumerate();
        *d = products.map(|(output, v)| parameters[weight(layer, output, input)] * v).sum();
    }
}
