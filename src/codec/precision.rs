//! The encoder's choice of how finely each network's weights are kept: the coarsest that its outputs allow.
//!
//! A network is run on a sample of the scene's own anchors as it is and as its decoder will have it; the
//! difference is measured after the activations, where it is a difference in opacity, shape or colour.

use super::networks::{self, QuantisedMlp};
use crate::domain::{AnchorScene, DenseLayer, Mlp, anchors::VIEW_INPUTS};

/// Magnitudes of the weights' integers, coarsest first: 8 to 12 bits.
const LEVELS: [u16; 5] = [127, 255, 511, 1023, 2047];

/// Largest root mean square difference after activation. As an error of every pixel it would be 60 dB, which
/// takes 0.01 dB from an image of 34 dB; 8 bits a weight alone come near 50 dB, which takes 0.1 dB.
const TOLERANCE: f64 = 1e-3;

/// Anchors in the sample.
const SAMPLE: usize = 256;

/// What a network's outputs go through before they mean anything (method.md §1.4).
#[derive(Debug, Clone, Copy)]
pub(super) enum Activation {
    /// Opacity.
    Tanh,
    /// Colour.
    Logistic,
    /// Three logistic scales and a quaternion to be normalised, an offset.
    Covariance,
}

/// Quantises `mlp` as coarsely as [`TOLERANCE`] allows.
pub(super) fn quantise(mlp: &Mlp, activation: Activation, inputs: &[Vec<f32>]) -> QuantisedMlp {
    let exact: Vec<Vec<f64>> =
        inputs.iter().map(|input| activate(activation, &forward(mlp, input))).collect();
    let mut quantised = QuantisedMlp::new();
    for levels in LEVELS {
        quantised = networks::quantise(mlp, levels);
        let decoded = networks::as_decoded(&quantised);
        let (mut squares, mut count) = (0.0, 0_u32);
        for (input, exact) in inputs.iter().zip(&exact) {
            for (value, exact) in activate(activation, &forward(&decoded, input)).iter().zip(exact) {
                squares += (value - exact) * (value - exact);
                count += 1;
            }
        }
        if squares <= TOLERANCE * TOLERANCE * f64::from(count) {
            break;
        }
    }
    quantised
}

/// Inputs as a renderer would make them: features of evenly spaced anchors, seen along an axis or a diagonal
/// from as far as the scene is large.
pub(super) fn sample_inputs(scene: &AnchorScene) -> Vec<Vec<f32>> {
    let distance = half_diagonal(scene);
    let stride = scene.len().div_ceil(SAMPLE).max(1);
    (0..scene.len())
        .step_by(stride)
        .zip(0_usize..)
        .map(|(anchor, turn)| {
            let signs = [turn % 3, turn / 3 % 3, turn / 9 % 3].map(|digit| digit as f32 - 1.0);
            let length = signs.iter().map(|sign| sign * sign).sum::<f32>().sqrt().max(1.0);
            let mut input = scene.features[anchor * scene.feature_dim..][..scene.feature_dim].to_vec();
            let view: [f32; VIEW_INPUTS] =
                [signs[0] / length, signs[1] / length, signs[2] / length, distance];
            input.extend(view);
            input
        })
        .collect()
}

fn half_diagonal(scene: &AnchorScene) -> f32 {
    let square: f32 = (0..3)
        .map(|axis| {
            let coordinates = || scene.cells.iter().map(|cell| cell[axis]);
            let extent = coordinates().max().unwrap_or(0).abs_diff(coordinates().min().unwrap_or(0));
            let edge = extent as f32 * scene.lattice.voxel;
            edge * edge
        })
        .sum();
    0.5 * square.sqrt()
}

fn forward(mlp: &Mlp, input: &[f32]) -> Vec<f32> {
    let mut values = input.to_vec();
    for (index, layer) in mlp.layers.iter().enumerate() {
        if index > 0 {
            values.iter_mut().for_each(|value| *value = value.max(0.0));
        }
        values = dense(layer, &values);
    }
    values
}

fn dense(layer: &DenseLayer, input: &[f32]) -> Vec<f32> {
    let rows = layer.weights.chunks(layer.inputs).zip(&layer.bias);
    rows.map(|(row, bias)| row.iter().zip(input).fold(*bias, |sum, (weight, value)| sum + weight * value))
        .collect()
}

fn activate(activation: Activation, outputs: &[f32]) -> Vec<f64> {
    let logistic = |value: &f32| 1.0 / (1.0 + libm::exp(-f64::from(*value)));
    match activation {
        Activation::Tanh => outputs.iter().map(|value| libm::tanh(f64::from(*value))).collect(),
        Activation::Logistic => outputs.iter().map(logistic).collect(),
        Activation::Covariance => outputs
            .chunks(7)
            .flat_map(|offset| {
                let (scales, quaternion) = offset.split_at(3);
                let square: f64 = quaternion.iter().map(|value| f64::from(*value) * f64::from(*value)).sum();
                let length = square.sqrt().max(1e-12);
                let unit = quaternion.iter().map(move |value| f64::from(*value) / length);
                scales.iter().map(logistic).chain(unit).collect::<Vec<_>>()
            })
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_forward_pass_has_relu_between_layers_only() {
        let identity = |scale: f32, bias: f32| DenseLayer {
            inputs: 2,
            outputs: 2,
            weights: vec![scale, 0.0, 0.0, scale],
            bias: vec![bias; 2],
        };
        let mlp = Mlp { layers: vec![identity(1.0, 0.0), identity(-2.0, 1.0)] };
        assert_eq!(forward(&mlp, &[3.0, -4.0]), [-5.0, 1.0]);
    }

    #[test]
    fn a_network_that_saturates_is_kept_coarser_than_one_that_does_not() {
        let mlp = |bias: f32| Mlp {
            layers: vec![DenseLayer {
                inputs: 8,
                outputs: 4,
                weights: (0..32).map(|index| ((index * 29 % 31) as f32 - 15.0) * 0.05).collect(),
                bias: vec![bias; 4],
            }],
        };
        let inputs: Vec<Vec<f32>> = (0..64)
            .map(|turn| (0..8).map(|index| ((turn * 7 + index * 5) % 13) as f32 - 6.0).collect())
            .collect();
        let finest = |mlp: &Mlp| {
            let decoded = networks::as_decoded(&quantise(mlp, Activation::Tanh, &inputs));
            let steps = decoded.layers[0].weights.iter().zip(&mlp.layers[0].weights);
            steps.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        assert!(finest(&mlp(100.0)) > 2.0 * finest(&mlp(0.0)));
    }
}
