//! Dense layers and their gradients, one column at a time.

use crate::model::LayerSpec;

fn weight(layer: &LayerSpec, output: usize, input: usize) -> usize {
    layer.weights + input * layer.outputs + output
}

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

/// max(x, 0).
#[must_use]
pub fn relu(column: Vec<f64>) -> Vec<f64> {
    column.into_iter().map(|v| v.max(0.0)).collect()
}

/// The gradient before the ReLU from the values after it.
#[must_use]
pub fn relu_gate(values: &[f64], gradient: Vec<f64>) -> Vec<f64> {
    gradient.into_iter().zip(values).map(|(d, v)| if *v > 0.0 { d } else { 0.0 }).collect()
}

/// The transposed layer: writes `Wᵀ d_output` into the layer's part of the input column's gradient.
pub fn dense_input_gradient(layer: &LayerSpec, parameters: &[f64], d_output: &[f64], d_input: &mut [f64]) {
    let d_output = &d_output[layer.output_row..][..layer.outputs];
    for (input, d) in d_input[layer.input_row..][..layer.inputs].iter_mut().enumerate() {
        let products = d_output.iter().enumerate();
        *d = products.map(|(output, v)| parameters[weight(layer, output, input)] * v).sum();
    }
}

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

/// Adds the runs.
#[must_use]
pub fn sum_partials(parameters: usize, partials: &[Vec<f64>]) -> Vec<f64> {
    (0..parameters).map(|parameter| partials.iter().map(|run| run[parameter]).sum()).collect()
}

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

/// As [`dense`], from packed weights.
#[must_use]
pub fn dense_software(layer: &LayerSpec, packed: &[Vec<f64>], parameters: &[f64], input: &[f64]) -> Vec<f64> {
    let x = &input[layer.input_row..][..layer.inputs];
    let biases = &parameters[layer.bias..][..layer.outputs];
    let sum = |weights: &[f64]| x.iter().zip(weights).map(|(x, w)| x * w).sum::<f64>();
    packed.iter().zip(biases).map(|(weights, bias)| sum(weights) + bias).collect()
}

/// As [`dense_weight_gradient`], into rows of outputs: one an input and a last one for the bias.
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

/// Adds the runs of [`dense_weight_gradient_software`] into the gradients of all parameters.
pub fn sum_weight_gradient(layer: &LayerSpec, partials: &[Vec<Vec<f64>>], sums: &mut [f64]) {
    for output in 0..layer.outputs {
        let sum = |row: usize| partials.iter().map(|run| run[row][output]).sum::<f64>();
        for input in 0..layer.inputs {
            sums[weight(layer, output, input)] = sum(input);
        }
        sums[layer.bias + output] = sum(layer.inputs);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{NetworkLayout, Shape};

    #[test]
    fn both_sets_of_kernels_compute_the_same() {
        let layout = NetworkLayout::new(Shape::new(5, 3));
        let number = |i: usize| ((i * 7919 % 1000) as f64) / 500.0 - 1.0;
        let parameters: Vec<f64> = (0..layout.parameters).map(number).collect();
        let columns = |first: usize, rows: usize| -> Vec<Vec<f64>> {
            (0..4).map(|c| (0..rows).map(|i| number(first + rows * c + i)).collect()).collect()
        };
        let (inputs, d_outputs) = (columns(100, 15), columns(500, 33));
        for layer in layout.layers() {
            let packed = pack_weights(&layer, &parameters);
            assert!(packed.iter().all(|row| row.len() % 4 == 0));
            for input in &inputs {
                let found = dense_software(&layer, &packed, &parameters, input);
                assert_eq!(found, dense(&layer, &parameters, input));
            }
            let mut expected = vec![0.0; layout.parameters];
            dense_weight_gradient(&layer, &inputs, &d_outputs, &mut expected);
            let mut partial = vec![vec![0.0; layer.outputs]; layer.inputs + 1];
            dense_weight_gradient_software(&layer, &inputs, &d_outputs, &mut partial);
            let mut found = vec![0.0; layout.parameters];
            sum_weight_gradient(&layer, &[partial], &mut found);
            assert_eq!(found, expected);
        }
    }
}
