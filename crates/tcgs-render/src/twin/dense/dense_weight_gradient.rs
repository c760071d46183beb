//! The gradient by the weights and the bias of a dense layer.

use super::weight::weight;
use crate::model::LayerSpec;

/// Writes the gradient by the layer's weights and bias, summed over one run of columns, into `partial`.
pub fn dense_weight_gradient(
    layer: &LayerSpec,
    inputs: &[Vec<f64>],
    d_outputs: &[Vec<f64>],
    partial: &mut [f64],
) {
    for (x, d) in inputs.iter().zip(d_outputs) {
        let (x, d) = (&x[layer.input_row..], &d[layer.output_row..]);
        for output in 0..layer.outputs {
            for input in 0..layer.inputs {
                partial[weight(layer, output, input)] += d[output] * x[input];
            }
            partial[layer.bias + output] += d[output];
        }
    }
}
