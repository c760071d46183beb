//! The f64 twins' gradients against central differences of their own forward pass.

use glam::DVec3;
use tcgs_codec::domain::{SceneScale, ViewDegree};
use tcgs_render::{
    model::{ModelShape, NetworkLayout},
    twin::{Gaussian, GaussianGradient, neural as twin},
};

use super::scene::{Scene, projection, random_gradients};
use crate::support::random;

const STEP: f64 = 1e-6;

fn dot(gaussian: &Gaussian, v: &GaussianGradient) -> f64 {
    let quat: f64 = gaussian.quat.iter().zip(&v.quat).map(|(q, v)| q * v).sum();
    gaussian.mean.dot(v.mean)
        + gaussian.opacity * v.opacity
        + gaussian.scale.dot(v.scale)
        + quat
        + gaussian.color.dot(v.color)
}

#[test]
fn the_whole_chain_has_the_gradient_of_a_random_linear_loss_and_the_volume() {
    assert_has_the_gradient_of_its_forward_pass(ModelShape::new(4, 3), 40.0);
}

#[test]
fn with_harmonics_the_whole_chain_has_that_gradient_too() {
    let shape = ModelShape { view_degree: ViewDegree::MAX, ..ModelShape::new(4, 3) };
    assert_has_the_gradient_of_its_forward_pass(shape, 80.0);
}

fn assert_has_the_gradient_of_its_forward_pass(shape: ModelShape, volume_weight: f64) {
    let camera = random::camera(30, 20);
    let projection = projection(&camera);
    let scene = Scene::random(3, shape, 6, 1.0, &projection);
    let anchors = scene.twin();
    let spawned = twin::neural_forward(&projection, &anchors);
    assert_eq!(spawned.list.len(), 6, "all anchors are in view");
    let living = spawned.gaussians.iter().flatten().count();
    assert!(living > 3 && living < 15, "{living} of 18: both kinds of offsets are in the test");
    let v: Vec<GaussianGradient> = random_gradients(5, 18).into_iter().map(|(v, ..)| v).collect();
    let loss = |anchors: &twin::Anchors| -> f64 {
        let spawned = twin::neural_forward(&projection, anchors);
        let linear: f64 = spawned.gaussians.iter().zip(&v).filter_map(|(g, v)| g.map(|g| dot(&g, v))).sum();
        linear + volume_weight * twin::volume(&spawned.gaussians)
    };
    let plain = twin::neural_backward(&anchors, &spawned, &v, 0.0);
    let found = twin::neural_backward(&anchors, &spawned, &v, volume_weight);
    let moved = |change: &dyn Fn(&mut twin::Anchors, f64)| {
        let at = |by: f64| {
            let mut anchors = anchors.clone();
            change(&mut anchors, by);
            loss(&anchors)
        };
        (at(STEP) - at(-STEP)) / (2.0 * STEP)
    };
    // A central difference of a loss of order ten with this step is good to 1e-8 or so.
    for (i, found) in found.rows.iter().enumerate() {
        let expected = moved(&|anchors, by| anchors.rows[i] += by);
        assert!(
            (found - expected).abs() < 1e-6 * (1.0 + expected.abs()),
            "row value {i}: {found} {expected}"
        );
    }
    for (i, found) in found.networks.iter().enumerate() {
        let expected = moved(&|anchors, by| anchors.networks[i] += by);
        assert!(
            (found - expected).abs() < 1e-6 * (1.0 + expected.abs()),
            "parameter {i}: {found} {expected}"
        );
    }
    let share = found.rows.iter().zip(&plain.rows).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(share > 1e-2, "the regularizer is large enough to be seen: {share:e}");
}

#[test]
fn a_dense_layer_has_the_gradients_of_its_forward_pass() {
    let layout = NetworkLayout::new(ModelShape::new(4, 2));
    // The color head: it reads and writes in the middle of its columns.
    let layer = layout.heads[2];
    let number = |i: usize| ((i * 7919 % 1000) as f64) / 500.0 - 1.0;
    let parameters: Vec<f64> = (0..layout.parameters).map(number).collect();
    let inputs: Vec<Vec<f64>> = (0..3).map(|c| (0..12).map(|i| number(100 + 12 * c + i)).collect()).collect();
    let d_outputs: Vec<Vec<f64>> =
        (0..3).map(|c| (0..22).map(|i| number(500 + 22 * c + i)).collect()).collect();
    let loss = |parameters: &[f64], inputs: &[Vec<f64>]| -> f64 {
        let columns = inputs.iter().zip(&d_outputs);
        columns
            .map(|(input, d)| {
                let output = twin::dense(&layer, parameters, input);
                output.iter().zip(&d[layer.output_row..]).map(|(y, d)| y * d).sum::<f64>()
            })
            .sum()
    };
    let mut found = vec![0.0; layout.parameters];
    twin::dense_weight_gradient(&layer, &inputs, &d_outputs, &mut found);
    for (i, found) in found.iter().enumerate() {
        let at = |by: f64| {
            let mut parameters = parameters.clone();
            parameters[i] += by;
            loss(&parameters, &inputs)
        };
        // The loss is linear in every parameter, so the step can be large.
        assert!((found - (at(0.5) - at(-0.5))).abs() < 1e-12, "parameter {i}");
    }
    for (column, d_output) in d_outputs.iter().enumerate() {
        let mut found = vec![0.0; 12];
        twin::dense_input_gradient(&layer, &parameters, d_output, &mut found);
        for (i, found) in found.iter().enumerate() {
            let at = |by: f64| {
                let mut inputs = inputs.clone();
                inputs[column][i] += by;
                loss(&parameters, &inputs)
            };
            assert!((found - (at(0.5) - at(-0.5))).abs() < 1e-12, "input {i} of column {column}");
        }
    }
}

#[test]
fn layers_agree_with_the_networks_of_the_scene() {
    let shape = ModelShape::new(4, 2);
    let projection = projection(&random::camera(30, 20));
    let scene = Scene::random(3, shape, 1, 1.0, &projection);
    let spawned = twin::neural_forward(&projection, &scene.twin());
    let networks = NetworkLayout::new(shape).to_networks(&scene.networks);
    let outputs = [networks.opacity, networks.covariance, networks.color].into_iter().flat_map(|network| {
        let last = network.layers.len() - 1;
        network.layers.iter().enumerate().fold(spawned.input[0].clone(), |x, (index, layer)| {
            let rows = layer.weights.chunks_exact(layer.inputs).zip(&layer.bias);
            let y = rows.map(|(row, bias)| {
                let sum: f64 = row.iter().zip(&x).map(|(w, x)| f64::from(*w) * x).sum();
                let value = sum + f64::from(*bias);
                if index < last { value.max(0.0) } else { value }
            });
            y.collect()
        })
    });
    for (found, expected) in spawned.outputs[0].iter().zip(outputs) {
        assert!((found - expected).abs() < 1e-12, "{found} {expected}");
    }
}

#[test]
fn the_input_is_feature_direction_and_distance_in_the_scenes_unit() {
    let shape = ModelShape::new(4, 2);
    let camera = random::camera(30, 20);
    let row: Vec<f64> = (0..shape.row()).map(|i| i as f64).collect();
    let position = DVec3::new(0.5, -0.25, 0.125);
    let input = twin::network_input(&projection(&camera), position, shape, &row, SceneScale::DEFAULT);
    let ray = position - camera.pose.center();
    assert_eq!(input[..4], row[..4]);
    assert!((DVec3::from_slice(&input[4..7]) - ray.normalize()).length() < 1e-12);
    assert!((input[7] - ray.length()).abs() < 1e-12);
    let eighth = SceneScale::new(0.125).expect("a length");
    let in_eighths = twin::network_input(&projection(&camera), position, shape, &row, eighth);
    assert_eq!(in_eighths[..7], input[..7]);
    assert_eq!(in_eighths[7], 8.0 * input[7]);
    let seeing = ModelShape { view_degree: ViewDegree::MAX, ..shape };
    let with_harmonics =
        twin::network_input(&projection(&camera), position, seeing, &row, SceneScale::DEFAULT);
    assert_eq!(with_harmonics[..8], input);
    let harmonics: Vec<f64> = seeing.view_degree.harmonics(ray.normalize()).collect();
    assert!(
        with_harmonics[8..].iter().zip(&harmonics).all(|(found, expected)| (found - expected).abs() < 1e-12)
    );
    assert_eq!((with_harmonics.len(), harmonics.len()), (20, 12));
    // At the camera itself there is no direction, and nothing that is not a number either.
    let center = camera.pose.center();
    let there = twin::network_input(&projection(&camera), center, shape, &row, eighth);
    assert!(there.iter().all(|v| v.is_finite()));
}
