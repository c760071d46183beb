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
