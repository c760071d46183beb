//! The device against the twins.

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::ContextKind,
    gpu::Device,
    render::RenderError,
    train::{
        ContextError, TrainError,
        context::{ContextAnchors, ContextNet, ContextPass, ContextState, PlaneConfig, PlaneSource},
        twin::context as twin,
    },
};

use super::scene::{KINDS, Scene, TWO_LAYERS, passes};
use crate::support::{
    gpu::{choice, gpu},
    oracle::relative_l2,
};

fn net(scene: &Scene) -> ContextNet {
    let state = ContextState::new(scene.values.clone());
    let mut net = ContextNet::new(&gpu(), scene.layout.config, &state).expect("a model");
    net.place(&scene.anchors).expect("placed");
    net
}

/// Outputs of the sampled anchors, column by column.
fn columns(net: &ContextNet, rows: usize) -> Vec<Vec<f32>> {
    let device = gpu();
    let count = device.read_range(net.sample(), 0, 1).expect("read")[0] as usize;
    let flat = device.read(net.outputs()).expect("read");
    (0..count).map(|column| (0..rows).map(|row| flat[row * net.columns() + column]).collect()).collect()
}

/// Outputs and gradients of one pass. What the sample does not cover is NaN, so that nothing may read it.
fn on_device(net: &mut ContextNet, scene: &Scene, pass: &ContextPass) -> (Vec<Vec<f32>>, Vec<f32>) {
    let device = gpu();
    let rows = scene.layout.config.output_rows()[3];
    let mut recorder = device.recorder("context forward");
    net.forward(&mut recorder, &scene.sample, pass).expect("recorded");
    recorder.submit().expect("submitted");
    let mut d_outputs = vec![f32::NAN; net.output_gradients().len()];
    for (column, d) in scene.d_outputs.iter().enumerate() {
        for (row, d) in d.iter().enumerate() {
            d_outputs[row * net.columns() + column] = *d;
        }
    }
    device.write(net.output_gradients(), &d_outputs);
    let mut recorder = device.recorder("context backward");
    net.backward(&mut recorder).expect("recorded");
    recorder.submit().expect("submitted");
    (columns(net, rows), device.read(net.gradients()).expect("read"))
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|value| f64::from(*value)).collect()
}

fn assert_matches(scene: &Scene, pass: &ContextPass, found: &(Vec<Vec<f32>>, Vec<f32>)) {
    let what = format!("{:?} {pass:?}", scene.layout.config.kind);
    let twin = scene.twin(*pass, true);
    let values = scene.wide_values();
    let on = twin.forward(&values);
    let error = relative_l2(&wide(&found.0.concat()), &on.outputs.concat());
    assert!(error < 1e-5, "{what}: outputs differ by {error:e}");
    let expected = twin.backward(&values, &on, &scene.wide_gradients());
    let layout = &scene.layout;
    let gradients = wide(&found.1);
    let layers = layout.planes.end..layout.latents.start;
    for range in [0..layout.networks, layout.planes.clone(), layers, layout.latents.clone()] {
        let error = relative_l2(&gradients[range.clone()], &expected[range.clone()]);
        assert!(error < 1e-5, "{what}: gradients of {range:?} differ by {error:e}");
    }
}

#[test]
fn the_model_matches_its_twin_in_every_pass() {
    let rounded = |levels| move |pass| ContextPass { levels: Some(levels), ..pass };
    for kind in KINDS {
        let scene = Scene::random(1, kind, TWO_LAYERS, 300, 90);
        let mut net = net(&scene);
        let frozen = ContextPass { planes_learn: false, ..passes()[3] };
        for pass in passes()
            .into_iter()
            .chain([frozen])
            .chain(passes().map(rounded(127)))
            .chain(passes().map(rounded(7)))
        {
            let found = on_device(&mut net, &scene, &pass);
            assert_matches(&scene, &pass, &found);
        }
    }
}

#[test]
fn planes_of_any_depth_match_the_twin() {
    for planes in [
        PlaneConfig { edge: 8, channels: 4, layers: 0, hidden: 0, latents: 4 },
        PlaneConfig { edge: 32, channels: 4, layers: 1, hidden: 0, latents: 6 },
        PlaneConfig { edge: 64, channels: 4, layers: 3, hidden: 4, latents: 2 },
    ] {
        let scene = Scene::random(2, ContextKind::TriPlaneKnn, planes, 200, 70);
        let mut net = net(&scene);
        for pass in passes() {
            let found = on_device(&mut net, &scene, &pass);
            assert_matches(&scene, &pass, &found);
        }
    }
}

#[test]
fn samples_of_any_size_match_the_twin_one_after_another() {
    // More than a run of the weight gradients, none, one, few: whatever columns held before does not matter.
    let first = Scene::random(3, ContextKind::TriPlaneKnn, TWO_LAYERS, 10, 1);
    let mut net = net(&first);
    for (count, sampled) in [(2_600, 2_300), (2_600, 0), (5, 1), (3, 3), (700, 100)] {
        let mut scene = Scene::random(3, ContextKind::TriPlaneKnn, TWO_LAYERS, count, sampled);
        scene.values.clone_from(&first.values);
        net.place(&scene.anchors).expect("placed");
        let mut fresh = self::net(&scene);
        let found = on_device(&mut net, &scene, &passes()[1]);
        assert_eq!(found, on_device(&mut fresh, &scene, &passes()[1]), "{sampled} of {count}");
        assert_matches(&scene, &passes()[1], &found);
    }
}

#[test]
fn equal_passes_have_equal_bits() {
    let scene = Scene::random(4, ContextKind::TriPlaneKnn, TWO_LAYERS, 900, 400);
    let mut net = net(&scene);
    let bits = |found: (Vec<Vec<f32>>, Vec<f32>)| -> Vec<u32> {
        found.0.concat().into_iter().chain(found.1).map(f32::to_bits).collect()
    };
    for pass in passes() {
        let first = bits(on_device(&mut net, &scene, &pass));
        on_device(&mut net, &scene, &passes()[2]);
        assert!(bits(on_device(&mut net, &scene, &pass)) == first, "{pass:?}");
    }
}

#[test]
fn latents_made_parameters_change_nothing() {
    let device = gpu();
    let zero_layers = PlaneConfig { edge: 8, channels: 4, layers: 0, hidden: 0, latents: 4 };
    for planes in [TWO_LAYERS, zero_layers] {
        let scene = Scene::random(5, ContextKind::TriPlane, planes, 100, 40);
        let mut net = net(&scene);
        let pass = |source| ContextPass { source, ..ContextPass::RAW };
        let before = on_device(&mut net, &scene, &pass(PlaneSource::Reconstructed)).0;
        let mut recorder = device.recorder("switch");
        net.latents_from_planes(&mut recorder).expect("recorded");
        recorder.submit().expect("submitted");
        let after = on_device(&mut net, &scene, &pass(PlaneSource::Latents)).0;
        assert!(before == after, "{planes:?}");
        let values = net.save().expect("read").values;
        assert!(values[..scene.layout.latents.start] == scene.values[..scene.layout.latents.start]);
        assert!(values[scene.layout.latents.clone()] != scene.values[scene.layout.latents.clone()]);
    }
}

#[test]
fn rounded_weights_are_the_twins_bits() {
    let device = gpu();
    let mut scene = Scene::random(6, ContextKind::TriPlaneKnn, TWO_LAYERS, 50, 5);
    let mut rng = Pcg64::seed_from_u64(6);
    // Rows of every size: from less than the finest step to more than the coarsest can hold; and ties.
    for layer in std::iter::once(&scene.layout.hidden).chain(&scene.layout.heads) {
        for output in 0..layer.outputs {
            let size = 2_f32.powi(rng.random_range(-30..12));
            for input in 0..layer.inputs {
                let tie = rng.random_range(-255..256) as f32 / 2.0;
                scene.values[layer.weights + input * layer.outputs + output] =
                    size * if output % 2 == 0 { tie / 128.0 } else { rng.random_range(-1.0..1.0) };
            }
        }
    }
    let mut net = net(&scene);
    for levels in [127, 31, 7] {
        let pass = ContextPass { levels: Some(levels), source: PlaneSource::Latents, ..ContextPass::RAW };
        on_device(&mut net, &scene, &pass);
        let expected = scene.twin(pass, true).forward(&scene.wide_values()).stored;
        let found = device.read(net.stored()).expect("read");
        // All products are exact in both; a zero may have either sign.
        assert!(wide(&found) == expected, "{levels} levels");
        assert!(found != scene.values);
    }
}

#[test]
fn rounding_latents_ends_at_a_byte() {
    let mut scene = Scene::random(7, ContextKind::TriPlane, TWO_LAYERS, 60, 30);
    scene.values[scene.layout.latents.clone()].iter_mut().for_each(|latent| *latent *= 40.0);
    let pass = passes()[3];
    let latents = &scene.wide_values()[scene.layout.latents.clone()];
    assert!(twin::round_latents(latents).iter().any(|latent| latent.abs() == 127.0 / 16.0));
    let found = on_device(&mut net(&scene), &scene, &pass);
    assert_matches(&scene, &pass, &found);
}

#[test]
fn what_does_not_fit_is_refused() {
    let device = gpu();
    let scene = Scene::random(8, ContextKind::TriPlane, TWO_LAYERS, 20, 5);
    let short = ContextState::new(scene.values[1..].to_vec());
    let refused = ContextNet::new(&device, scene.layout.config, &short);
    assert!(matches!(refused, Err(TrainError::Context(ContextError::Parameters { .. }))));
    let mut net = net(&scene);
    let mut recorder = device.recorder("refused");
    let early = net.backward(&mut recorder);
    assert!(matches!(early, Err(TrainError::Render(RenderError::OutOfStep))));
    for sample in [[3, 20], [4, 4]] {
        let refused = net.forward(&mut recorder, &sample, &ContextPass::RAW);
        assert!(matches!(refused, Err(TrainError::Context(ContextError::Anchors(_)))), "{sample:?}");
    }
    let stray = ContextAnchors { neighbors: vec![20; 20], ..scene.anchors.clone() };
    assert!(matches!(net.place(&stray), Err(TrainError::Context(ContextError::Anchors(_)))));
}

#[test]
fn no_more_memory_is_taken_than_is_said() {
    let device: Arc<Device> = Device::new(&choice()).expect("a device");
    // The buffer of constants is the device's own.
    device.recorder("constants").uniform(&[0_u32]).expect("room");
    for kind in KINDS {
        let scene = Scene::random(9, kind, TWO_LAYERS, 3_000, 600);
        let before = device.allocated_bytes();
        let state = ContextState::new(scene.values.clone());
        let mut net = ContextNet::new(&device, scene.layout.config, &state).expect("a model");
        net.place(&scene.anchors).expect("placed");
        let mut recorder = device.recorder("context");
        net.forward(&mut recorder, &scene.sample, &passes()[1]).expect("recorded");
        net.backward(&mut recorder).expect("recorded");
        recorder.submit().expect("submitted");
        device.wait().expect("done");
        let taken = device.allocated_bytes() - before;
        let said = ContextNet::bytes(&scene.layout.config, 3_000, 600).expect("known sizes");
        assert!(taken <= said && said < taken + taken / 4 + 4096, "{kind:?}: {taken} taken, {said} said");
    }
}
