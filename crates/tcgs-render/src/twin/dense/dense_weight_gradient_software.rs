//! The gradient by weights and bias as software adapters compute it.

use crate::model::LayerSpec;

/// As [`dense_weight_gradient`](fn@super::dense_weight_gradient), into rows of outputs: one an input and a last one for the bias.
pub fn dense_weight_gradient_software(
    layer: &LayerSpec,
    inputs: &[Vec<f64>],
    d_outputs: &[Vec<f64>],
    partial: &mut [Vec<f64>],
) {
    for (x, d) in inputs.iter().zip(d_outputs) {
        let x = x[layer.input_row..][..layer.inputs].iter().chain(&[1.0]);
        for (row, x) in partial.iter_mut().zip(x) {
            for (sum, d) in row.iter_mut().zip(&d[layer.output_row..][..layer.outputs]) {
                *sum += d * x;
            }
        }
    }
}
