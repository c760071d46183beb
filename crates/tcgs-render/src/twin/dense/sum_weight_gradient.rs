//! The sum of the runs of weight gradients of software adapters.

use super::weight::weight;
use crate::model::LayerSpec;

/// Adds the runs of [`dense_weight_gradient_software`](fn@super::dense_weight_gradient_software) into the gradients of all parameters.
pub fn sum_weight_gradient(layer: &LayerSpec, partials: &[Vec<Vec<f64>>], sums: &mut [f64]) {
    for output in 0..layer.outputs {
        let sum = |row: usize| partials.iter().map(|run| run[row][output]).sum::<f64>();
        for input in 0..layer.inputs {
            sums[weight(layer, output, input)] = sum(input);
        }
        sums[layer.bias + output] = sum(layer.inputs);
    }
}
