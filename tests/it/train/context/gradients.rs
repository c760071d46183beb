//! The twins against the definitions and against central differences.

use tcgs::{
    domain::{AttributeGroup, ContextKind, DenseLayer, context_model::UpLayer},
    train::{
        context::{ContextPass, ConvSpec, PlaneConfig, PlaneSource},
        twin::context as twin,
    },
};

use super::scene::{KINDS, Scene, TWO_LAYERS, passes};

#[test]
fn every_parameter_has_the_gradient_of_a_random_linear_loss() {
    // Short: few kinks of the absolute difference lie between the ends.
    const STEP: f64 = 1e-6;
    // A whole pass for each parameter: as small as has two layers.
    const SMALL: PlaneConfig = PlaneConfig { edge: 8, channels: 4, layers: 2, hidden: 3, latents: 2 };
    for (kind, pass) in KINDS.into_iter().flat_map(|kind| passes().map(|pass| (kind, pass))) {
        let scene = Scene::random(7, kind, SMALL, 40, 9);
        let twin = scene.twin(pass, false);
        let (values, d_outputs) = (scene.wide_values(), scene.wide_gradients());
        let loss = |values: &[f64]| {
            let on = twin.forward(values);
            let terms = on.outputs.iter().zip(&d_outputs).flat_map(|(y, d)| y.iter().zip(d));
            terms.map(|(y, d)| y * d).sum::<f64>() + on.reconstruction_loss
        };
        let found = twin.backward(&values, &twin.forward(&values), &d_outputs);
        let mut used = 0;
        // Some of every layer and part: a prime, so that all rows and taps have their turn.
        for parameter in (0..values.len()).step_by(13) {
            let at = |by: f64| {
                let mut values = values.clone();
                values[parameter] += by;
                loss(&values)
            };
            let expected = (at(STEP) - at(-STEP)) / (2.0 * STEP);
            let error = (found[parameter] - expected).abs();
            assert!(
                error < 1e-6 * (1.0 + expected.abs()),
                "{kind:?} {pass:?} {parameter}: {} {expected}",
                found[parameter]
            );
            used += usize::from(found[parameter] != 0.0);
        }
        assert!(used > scene.layout.networks / 13 / 2, "{kind:?} {pass:?}: {used} gradients are not zero");
    }
}

#[test]
fn planes_that_do_not_learn_have_no_gradient() {
    let scene = Scene::random(8, ContextKind::TriPlaneKnn, TWO_LAYERS, 40, 15);
    let pass = ContextPass { planes_learn: false, ..passes()[2] };
    let twin = scene.twin(pass, false);
    let values = scene.wide_values();
    let found = twin.backward(&values, &twin.forward(&values), &scene.wide_gradients());
    assert!(found[scene.layout.networks..].iter().all(|d| *d == 0.0));
    assert!(found[..scene.layout.networks].iter().any(|d| *d != 0.0));
}

/// The definition of an up-sampling layer, word by word.
fn up_sampled(layer: &UpLayer, edge: usize, input: &[f64]) -> Vec<f64> {
    let wide = 2 * edge;
    let mut out: Vec<f64> = layer.bias.iter().flat_map(|bias| vec![f64::from(*bias); wide * wide]).collect();
    for i in 0..layer.inputs {
        for (o, y, x) in
            (0..layer.outputs * edge * edge).map(|n| (n / edge / edge, n / edge % edge, n % edge))
        {
            for (v, u) in (0..9).map(|tap| (tap / 3, tap % 3)) {
                let (to_x, to_y) = (2 * x + u, 2 * y + v);
                if (1..=wide).contains(&to_x) && (1..=wide).contains(&to_y) {
                    let weight = f64::from(layer.weights[(i * layer.outputs + o) * 9 + 3 * v + u]);
                    out[(o * wide + to_y - 1) * wide + to_x - 1] += weight * input[(i * edge + y) * edge + x];
                }
            }
        }
    }
    out
}

fn dense(layer: &DenseLayer, input: &[f64]) -> Vec<f64> {
    let rows = layer.weights.chunks_exact(layer.inputs).zip(&layer.bias);
    rows.map(|(row, bias)| {
        row.iter().zip(input).map(|(w, x)| f64::from(*w) * x).sum::<f64>() + f64::from(*bias)
    })
    .collect()
}

#[test]
fn what_is_handed_to_the_encoder_computes_what_was_trained() {
    let pass = ContextPass { source: PlaneSource::Latents, ..ContextPass::RAW };
    for kind in KINDS {
        let scene = Scene::random(9, kind, TWO_LAYERS, 30, 6);
        let on = scene.twin(pass, true).forward(&scene.wide_values());
        if let Some(planes) = scene.layout.stored_planes(&scene.values) {
            assert_eq!((planes.plane_edge(), planes.plane_channels()), (16, 8));
            let one = planes.channels * planes.edge * planes.edge;
            let made: Vec<f64> = planes
                .latents
                .chunks_exact(one)
                .flat_map(|latent| {
                    let rounded = latent
                        .iter()
                        .map(|v| f64::from((16.0 * v).round_ties_even().clamp(-127.0, 127.0)) / 16.0);
                    let mut values: Vec<f64> = rounded.collect();
                    let mut edge = planes.edge;
                    for (index, layer) in planes.layers.iter().enumerate() {
                        values = up_sampled(layer, edge, &values);
                        if index + 1 < planes.layers.len() {
                            values.iter_mut().for_each(|v| *v = v.max(0.0));
                        }
                        edge *= 2;
                    }
                    values
                })
                .collect();
            assert!(made.iter().zip(&on.planes).all(|(a, b)| (a - b).abs() < 1e-12), "{kind:?}");
        }
        let rows = scene.layout.config.output_rows();
        for (input, outputs) in on.inputs.iter().zip(&on.outputs) {
            assert_eq!(input.len(), kind.inputs(8));
            for group in AttributeGroup::ALL {
                let network = scene.layout.network(&scene.values, group);
                let hidden =
                    dense(&network.layers[0], input).into_iter().map(|v| v.max(0.0)).collect::<Vec<_>>();
                let found = dense(&network.layers[1], &hidden);
                let expected = &outputs[rows[group as usize]..rows[group as usize + 1]];
                assert_eq!(found.len(), expected.len());
                assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{kind:?} {group:?}");
            }
        }
    }
}

#[test]
fn the_layers_are_each_others_gradients() {
    let spec = ConvSpec { coarse: 2, fine: 3, edge: 4, weights: 1, bias: 0 };
    let number = |i: usize| ((i * 7919 % 1000) as f64) / 500.0 - 1.0;
    let parameters: Vec<f64> = (0..1 + spec.weight_count()).map(number).collect();
    let fine: Vec<f64> = (0..spec.fine_values()).map(|i| number(i + 31)).collect();
    let coarse: Vec<f64> = (0..spec.coarse_values()).map(|i| number(i + 77)).collect();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let down = twin::conv_down(&spec, &parameters, None, &fine);
    let up = twin::conv_up(&spec, &parameters, None, &coarse);
    assert!((dot(&down, &coarse) - dot(&up, &fine)).abs() < 1e-12, "transposes of each other");
    let (weights, _) = twin::conv_weight_gradient(&spec, &fine, &coarse, true);
    assert!((dot(&weights, &parameters[1..]) - dot(&up, &fine)).abs() < 1e-12, "linear in the weights");
}

#[test]
fn weights_keep_as_many_binary_places_as_their_levels_allow() {
    let row = [0.9, -0.31, 0.004, 0.0];
    // 0.9 x 2^7 rounds to 115, 0.9 x 2^5 to 29, 0.9 x 2^3 to 7.
    for (levels, scale) in [(127, 128.0), (31, 32.0), (7, 8.0)] {
        let rounded = twin::round_weights(&row, levels);
        for (weight, found) in row.iter().zip(&rounded) {
            assert_eq!(*found, (weight * scale).round_ties_even() / scale);
        }
    }
    assert_eq!(twin::round_weights(&[200.0, -1.4], 127), [127.0, -1.0], "integers end at the levels");
    assert_eq!(twin::round_weights(&[0.0; 3], 7), [0.0; 3]);
    assert_eq!(twin::round_weights(&[127.49, 1.0], 127), [127.0, 1.0]);
    assert_eq!(twin::round_weights(&[1e-9], 127), [0.0], "there are 24 places at most");
}

#[test]
fn latents_are_sixteenths_of_a_byte() {
    let found = twin::round_latents(&[0.04, -0.03, 0.031_25, 0.093_75, 100.0, -100.0]);
    assert_eq!(found, [0.0625, 0.0, 0.0, 0.125, 127.0 / 16.0, -127.0 / 16.0]);
}
