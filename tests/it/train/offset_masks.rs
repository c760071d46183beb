//! Learnt masks: the twins against central differences, the kernels against the twins, and masked offsets are not drawn.

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs_codec::domain::{Camera, SceneScale};
use tcgs_engine::train::{Adam, AdamStep, FIRST_LOGIT, MaskRows, OffsetMasks, twin};
use tcgs_render::model::all_offsets;
use tcgs_render::{
    DeviceAnchors, NeuralGaussians, RasterSettings, Rasterizer,
    model::ModelShape,
    twin::{GaussianGradient, neural},
};

use super::neural_scene::{SMALL, Scene, USUAL, projection, random_gradients};
use crate::support::{gpu::gpu, oracle::relative_l2, random};

/// A logistic of 0.01, as published.
const LEVEL: f32 = -4.595_12;

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

fn f64s(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}

/// Logits on both sides of the level, none so close that rounding might move it across.
fn random_logits(rng: &mut Pcg64, count: usize) -> Vec<f32> {
    let away = |logit: &f32| (logit - LEVEL).abs() > 1e-3;
    std::iter::repeat_with(|| rng.random_range(-8.0..3.0_f32)).filter(away).take(count).collect()
}

/// A scene whose masks follow from random logits.
fn masked_scene(seed: u64, shape: ModelShape, count: usize, camera: &Camera) -> (Scene, MaskRows) {
    let mut scene = Scene::random(seed, shape, count, 2.0, &projection(camera));
    let mut rng = Pcg64::seed_from_u64(seed);
    let rows = MaskRows {
        logits: random_logits(&mut rng, count * shape.offsets),
        ..MaskRows::new(count * shape.offsets)
    };
    for (mask, logits) in scene.anchors.masks.iter_mut().zip(rows.logits.chunks(shape.offsets)) {
        *mask = twin::mask_bits(logits, LEVEL);
    }
    (scene, rows)
}

#[test]
fn bits_are_set_above_the_level_alone() {
    assert_eq!(twin::mask_bits(&[FIRST_LOGIT, LEVEL, -4.59, f32::NAN], LEVEL), 0b101);
    assert_eq!(twin::mask_bits(&[1.0; 32], 0.0), u32::MAX);
}

#[test]
fn the_twins_gradients_are_those_of_a_mask_that_passes_its_logistic_on() {
    let shape = ModelShape::new(4, 5);
    let camera = random::camera(30, 20);
    let scene = Scene::random(4, shape, 1, 0.5, &projection(&camera));
    let spawned = neural::neural_forward(&projection(&camera), &scene.twin());
    let living = spawned.gaussians.iter().flatten().count();
    assert!((1..5).contains(&living), "{living} of 5: both kinds of offsets are in the test");
    let v: Vec<GaussianGradient> = random_gradients(6, 5).into_iter().map(|(v, ..)| v).collect();
    let logits = [1.0, -1.5, 0.25, 2.0, -4.0];
    let weight = 0.3;
    // The forward mask is one; around it the straight-through mask moves as the logistic does.
    let loss = |moved: &[f64]| -> f64 {
        let offsets = spawned.gaussians.iter().zip(&v).zip(moved.iter().zip(&logits));
        offsets
            .map(|((gaussian, v), (moved, at))| {
                let mask = 1.0 + logistic(*moved) - logistic(*at);
                gaussian.map_or(0.0, |gaussian| v.opacity * gaussian.opacity * mask)
                    + weight * logistic(*moved)
            })
            .sum()
    };
    let mut found = twin::mask_loss(&logits, weight);
    twin::mask_gradient(&logits, &spawned.gaussians, &v, &mut found);
    for (k, found) in found.iter().enumerate() {
        let at = |by: f64| {
            let mut moved = logits;
            moved[k] += by;
            loss(&moved)
        };
        let expected = (at(1e-5) - at(-1e-5)) / 2e-5;
        assert!((found - expected).abs() < 1e-9, "logit {k}: {found} {expected}");
    }
}

fn check_against_twins(shape: ModelShape, count: usize) {
    let device = gpu();
    let camera = random::camera(40, 30);
    let (scene, rows) = masked_scene(count as u64, shape, count, &camera);
    let device_anchors = DeviceAnchors::upload(&device, &scene.anchors, &scene.networks).expect("anchors");
    let mut gaussians =
        NeuralGaussians::new(Arc::clone(&device), shape, 0.2, SceneScale::DEFAULT).expect("the kernels");
    let mut recorder = device.recorder("forward");
    gaussians.forward(&mut recorder, &device_anchors, &camera, 0.0).expect("recorded");
    recorder.submit().expect("submitted");
    let v: Vec<GaussianGradient> =
        random_gradients(7, count * shape.offsets).into_iter().map(|(v, ..)| v).collect();
    let by_opacity: Vec<[f32; 4]> = v.iter().map(|v| [0.0, 0.0, 0.0, v.opacity as f32]).collect();
    device.write(&gaussians.gaussian_gradients().expect("room").geometry, &by_opacity);

    let masks = OffsetMasks::upload(&device, shape, &rows).expect("room");
    // The weight of one offset is of the order of the view's gradients.
    let weight = 0.5 * (count * shape.offsets) as f32;
    let mut recorder = device.recorder("backward");
    let gradients =
        masks.backward(&mut recorder, &mut gaussians, &device_anchors, weight).expect("recorded").clone();
    let no = device.buffer("overflow flag", 1).expect("room");
    let adam = Adam::new(&device).expect("adam");
    masks
        .step(&mut recorder, &adam, AdamStep { number: 1, overflow_flag: &no }, 0.5, LEVEL, &device_anchors)
        .expect("recorded");
    recorder.submit().expect("submitted");

    let spawned = neural::neural_forward(&projection(&camera), &scene.twin());
    let logits = f64s(&rows.logits);
    let mut expected = twin::mask_loss(&logits, 0.5);
    for (index, anchor) in spawned.list.iter().map(|anchor| *anchor as usize).enumerate() {
        let own = anchor * shape.offsets..(anchor + 1) * shape.offsets;
        let born = index * shape.offsets..(index + 1) * shape.offsets;
        twin::mask_gradient(
            &logits[own.clone()],
            &spawned.gaussians[born.clone()],
            &v[born],
            &mut expected[own],
        );
    }
    let found = device.read(&gradients).expect("read");
    assert!(relative_l2(&f64s(&found), &expected) < 1e-5, "{count} anchors");

    let learnt = masks.read(&device).expect("read");
    // The first step of Adam is its rate.
    for ((now, was), gradient) in learnt.logits.iter().zip(&rows.logits).zip(&found) {
        assert!((now - was + 0.5 * gradient.signum()).abs() < 1e-4, "{was} became {now} by {gradient}");
    }
    let bits: Vec<u32> =
        learnt.logits.chunks(shape.offsets).map(|logits| twin::mask_bits(logits, LEVEL)).collect();
    assert_eq!(device.read(&device_anchors.masks).expect("read"), bits);
    assert!(count < 60 || bits != scene.anchors.masks, "the step crosses the level");
}

#[test]
fn gradients_steps_and_bits_match_the_twins() {
    for count in [1, 63, 65, 300] {
        check_against_twins(SMALL, count);
    }
    check_against_twins(USUAL, 70);
}

#[test]
fn masked_offsets_reach_neither_the_count_of_gaussians_nor_the_rasterizer() {
    let device = gpu();
    let camera = random::camera(40, 30);
    let (scene, _) = masked_scene(11, SMALL, 200, &camera);
    let drawn = |masks: &dyn Fn(u32) -> u32| {
        let mut scene = scene.clone();
        scene.anchors.masks.iter_mut().for_each(|mask| *mask = masks(*mask));
        let device_anchors =
            DeviceAnchors::upload(&device, &scene.anchors, &scene.networks).expect("anchors");
        let mut gaussians =
            NeuralGaussians::new(Arc::clone(&device), SMALL, 0.2, SceneScale::DEFAULT).expect("the kernels");
        let mut raster =
            Rasterizer::new(Arc::clone(&device), RasterSettings::default()).expect("a rasterizer");
        loop {
            let mut recorder = device.recorder("view");
            gaussians.forward(&mut recorder, &device_anchors, &camera, 0.0).expect("recorded");
            raster.forward(&mut recorder, gaussians.gaussians(), &camera, [0.0; 3]).expect("recorded");
            recorder.submit().expect("submitted");
            let counts = raster.counts().expect("counts");
            if !counts.overflowed {
                return [gaussians.counts().expect("counts")[1], counts.visible, counts.intersections];
            }
            raster.grow(&counts).expect("room");
        }
    };
    let all = drawn(&|_| all_offsets(SMALL));
    let (kept, masked) = (drawn(&|mask| mask), drawn(&|mask| !mask & all_offsets(SMALL)));
    assert!(kept.iter().chain(&masked).all(|count| *count > 0), "{kept:?} {masked:?}");
    assert_eq!([0, 1, 2].map(|i| kept[i] + masked[i]), all);
    assert_eq!(drawn(&|_| 0), [0; 3]);
}
