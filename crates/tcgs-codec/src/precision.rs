//! Chooses how finely each network's weights are quantized: as coarsely as its outputs allow.
//!
//! A network is run on a sample of the scene's own anchors before and after quantization; the difference is measured after the
//! activations, as a difference in opacity, shape or color.

use glam::Vec3;

use super::networks::{self, QuantizedMlp};
use crate::domain::{AnchorScene, DenseLayer, Mlp};

/// Magnitudes of the weights' integers, coarsest first: 4, 6 and 8 bits, which a network may have been trained for,
/// then up to 12.
const LEVELS: [u16; 7] = [7, 31, 127, 255, 511, 1023, 2047];

/// Largest root mean square difference after activation. Of the difference of a network, a fifth arrives in the pixels at
/// most: on the held-out views of a trained scene of 27 dB, opacities coarser by 0.0295 cost 0.06 dB, which is 0.0054 of
/// a pixel, by 0.0055 nothing that shows in a hundredth of a dB; shapes by 0.024 and colors by 0.011 nothing either. So
/// three networks with this difference each come to 0.001 of a pixel or 60 dB, which takes 0.01 dB from an image of 34 dB
/// and 0.02 dB from one of 37 dB.
const TOLERANCE: f64 = 3e-3;

/// Anchors in the sample.
const SAMPLE_ANCHORS: usize = 256;

/// The activation of a network's outputs (METHOD.md §2.3).
#[derive(Debug, Clone, Copy)]
pub(super) enum Activation {
    /// Opacity.
    Tanh,
    /// Color.
    Logistic,
    /// Three logistic scales and a quaternion to be normalized, an offset.
    Covariance,
}

/// Quantizes `mlp` as coarsely as [`TOLERANCE`] allows.
pub(super) fn quantize(mlp: &Mlp, activation: Activation, inputs: &[Vec<f32>]) -> QuantizedMlp {
    let exact: Vec<Vec<f64>> =
        inputs.iter().map(|input| activate(activation, &forward(mlp, input))).collect();
    let mut quantized = QuantizedMlp::new();
    for levels in LEVELS {
        quantized = networks::quantize(mlp, levels);
        if difference(&networks::dequantize(&quantized), activation, inputs, &exact) <= TOLERANCE {
            break;
        }
    }
    quantized
}

/// Root mean square difference of a network's activated outputs from `exact`.
fn difference(mlp: &Mlp, activation: Activation, inputs: &[Vec<f32>], exact: &[Vec<f64>]) -> f64 {
    let (mut squares, mut count) = (0.0, 0_u32);
    for (input, exact) in inputs.iter().zip(exact) {
        for (value, exact) in activate(activation, &forward(mlp, input)).iter().zip(exact) {
            squares += (value - exact) * (value - exact);
            count += 1;
        }
    }
    (squares / f64::from(count.max(1))).sqrt()
}

/// Inputs as a renderer would make them: features of evenly spaced anchors, seen along an axis or a diagonal
/// from as far as the scene is large.
pub(super) fn sample_inputs(scene: &AnchorScene) -> Vec<Vec<f32>> {
    let distance = half_diagonal(scene) / scene.scene_scale.length();
    let view_degree = scene.view_degree().unwrap_or_default();
    let stride = scene.len().div_ceil(SAMPLE_ANCHORS).max(1);
    (0..scene.len())
        .step_by(stride)
        .zip(0_usize..)
        .map(|(anchor, turn)| {
            let signs = [turn % 3, turn / 3 % 3, turn / 9 % 3].map(|digit| digit as f32 - 1.0);
            let length = signs.iter().map(|sign| sign * sign).sum::<f32>().sqrt().max(1.0);
            let mut input = scene.features[anchor * scene.feature_dim..][..scene.feature_dim].to_vec();
            let direction = signs.map(|sign| sign / length);
            input.extend(direction);
            input.push(distance);
            input.extend(view_degree.harmonics(Vec3::from(direction).as_dvec3()).map(|value| value as f32));
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
    use std::collections::BTreeSet;

    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::domain::{Lattice, NearPlane, RenderNetworks, SceneFrame, SceneScale};

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
    fn activations_are_those_of_opacity_color_and_shape() {
        let near = |activation: Activation, outputs: &[f32], expected: &[f64]| {
            let values = activate(activation, outputs);
            assert_eq!(values.len(), expected.len());
            let apart = values.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(apart < 1e-6, "{activation:?}: {values:?}");
        };
        near(Activation::Tanh, &[0.0, 1.0, -1.0], &[0.0, 0.761_594_2, -0.761_594_2]);
        near(Activation::Logistic, &[0.0, 1.0, -1.0], &[0.5, 0.731_058_6, 0.268_941_4]);
        let outputs = [0.0, 1.0, -1.0, 2.0, 0.0, -6.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0];
        let shapes = [0.5, 0.731_058_6, 0.268_941_4, 2.0 / 7.0, 0.0, -6.0 / 7.0, 3.0 / 7.0];
        near(Activation::Covariance, &outputs, &[&shapes[..], &[0.5, 0.5, 0.5, 0.0, 1.0, 0.0, 0.0]].concat());
    }

    #[test]
    fn inputs_are_of_evenly_spaced_anchors_seen_from_every_side() {
        let none = || Mlp { layers: Vec::new() };
        let scene = AnchorScene {
            lattice: Lattice { voxel: 0.5, origin: [9.0; 3] },
            // 2, 3 and 6 units wide, so that the diagonal is 7.
            cells: (0..600).map(|index| [index % 5 - 3, index % 7, index % 13 + 1]).collect(),
            feature_dim: 2,
            offsets_per_anchor: 1,
            features: (0_u16..1200).map(f32::from).collect(),
            scalings: Vec::new(),
            offsets: Vec::new(),
            masks: Vec::new(),
            networks: RenderNetworks { opacity: none(), covariance: none(), color: none() },
            near: NearPlane::DEFAULT,
            scene_scale: SceneScale::new(0.25).expect("a length"),
            frame: SceneFrame::WORLD,
        };
        let inputs = sample_inputs(&scene);
        assert_eq!(inputs.len(), 200);
        let mut views = BTreeSet::new();
        for (input, anchor) in inputs.iter().zip((0_u16..).step_by(3)) {
            let [first, second, x, y, z, distance] = input[..] else { panic!("{input:?}") };
            assert_eq!([first, second, distance], [f32::from(2 * anchor), f32::from(2 * anchor + 1), 14.0]);
            let length = (x * x + y * y + z * z).sqrt();
            assert!(length == 0.0 || (length - 1.0).abs() < 1e-6, "{input:?}");
            views.insert([x, y, z].map(|value| (value > 0.0, value < 0.0)));
        }
        assert_eq!(views.len(), 27);
    }

    #[test]
    fn each_bit_halves_the_difference_and_eight_suffice() {
        let mut random = Pcg64Mcg::seed_from_u64(9);
        let mut normal = move || {
            let (u, v): (f64, f64) = (random.random(), random.random());
            libm::sqrt(-2.0 * libm::log(1.0 - u)) * libm::cos(std::f64::consts::TAU * v)
        };
        let mut layer = |inputs: usize, outputs: usize| DenseLayer {
            inputs,
            outputs,
            weights: (0..inputs * outputs).map(|_| (normal() / libm::sqrt(inputs as f64)) as f32).collect(),
            bias: vec![0.0; outputs],
        };
        let mlp = Mlp { layers: vec![layer(36, 32), layer(32, 30)] };
        let inputs: Vec<Vec<f32>> =
            (0..100).map(|_| layer(36, 1).weights.iter().map(|x| x * 12.0).collect()).collect();
        let exact: Vec<_> =
            inputs.iter().map(|x| activate(Activation::Logistic, &forward(&mlp, x))).collect();
        let at = |levels| {
            let decoded = networks::dequantize(&networks::quantize(&mlp, levels));
            difference(&decoded, Activation::Logistic, &inputs, &exact)
        };
        let errors = LEVELS.map(at);
        println!("root mean square difference of colors with 4, 6, 8 to 12 weight bits: {errors:?}");
        let bits = LEVELS.map(|levels| f64::from(levels + 1).log2());
        for (errors, bits) in errors.windows(2).zip(bits.windows(2)) {
            let halves = (errors[0] / errors[1]).log2() / (bits[1] - bits[0]);
            assert!((0.75..1.3).contains(&halves), "{errors:?} at {bits:?} bits");
        }
        assert!(errors[1] > TOLERANCE && errors[2] <= TOLERANCE, "{errors:?}");
    }

    #[test]
    fn a_network_rounded_to_eight_bits_is_stored_as_it_is() {
        let row = |index: usize| ((index * 389 % 997) as f32 - 498.0) * 0.003;
        let mlp = Mlp {
            layers: vec![DenseLayer {
                inputs: 40,
                outputs: 60,
                weights: (0..2400).map(|index| row(index) * (1.0 + 0.013 * (index / 40) as f32)).collect(),
                bias: vec![0.0; 60],
            }],
        };
        let rounded = networks::dequantize(&networks::quantize(&mlp, 127));
        assert_ne!(rounded, mlp);
        assert_eq!(networks::dequantize(&networks::quantize(&rounded, 127)), rounded);
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
            let decoded = networks::dequantize(&quantize(mlp, Activation::Tanh, &inputs));
            let steps = decoded.layers[0].weights.iter().zip(&mlp.layers[0].weights);
            steps.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        assert!(finest(&mlp(100.0)) > 2.0 * finest(&mlp(0.0)));
    }
}
