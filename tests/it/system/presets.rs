//! Every preset and every part that can be left out, through a run of a few steps: what the file says and what it holds.

use std::sync::LazyLock;

use serde_json::json;
use tcgs::{
    codec::{DecodeLimits, Decoded, decode, inspect},
    domain::{CancelFlag, Choices, Component, Preset, SizeBound, TrainOptions},
    pipeline::{CheckpointPlan, JobOutput, Pipeline, RunJob as _},
    sample::{self, Settings},
    train::Schedule,
};
use tempfile::TempDir;

use crate::support::gpu::choice;

static DATASET: LazyLock<TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().expect("a folder");
    sample::write(&folder.path().join("set"), &Settings { points: 80, ..Settings::square(16) })
        .expect("writes");
    folder
});

fn run(options: &TrainOptions) -> (JobOutput, Decoded) {
    let options = options.clone().validated().expect("possible");
    let (checkpoints, cancel) = (CheckpointPlan::default(), CancelFlag::default());
    let output = Pipeline::new(choice())
        .run(&DATASET.path().join("set"), &options, &checkpoints, &mut |_, _| (), &cancel)
        .unwrap_or_else(|failure| panic!("{options:?}: {failure:?}"));
    let decoded = decode(&output.file, &DecodeLimits::default()).expect("decodes");
    assert_eq!(output.metrics.decode_sha256, decoded.decode_sha256);
    (output, decoded)
}

/// Steps, feature width, offsets per anchor, most anchors and weight of the rate, as `docs/SCHEDULE.md` states them.
const PRESETS: [(Preset, u32, usize, usize, usize, f64); 3] = [
    (Preset::Preview, 2_000, 32, 4, 40_000, 0.0005),
    (Preset::Standard, 10_000, 50, 10, 200_000, 0.0005),
    (Preset::Paper, 30_000, 50, 10, 400_000, 0.001),
];

#[test]
fn every_preset_has_its_schedule_and_trains() {
    assert_eq!(PRESETS.map(|preset| preset.0), Preset::ALL);
    for (preset, steps, features, offsets, max_anchors, lambda) in PRESETS {
        let schedule = Schedule::new(&TrainOptions { preset, ..TrainOptions::default() });
        assert_eq!((schedule.steps, schedule.lambda()), (steps, lambda), "{preset}");
        assert_eq!((schedule.shape.features, schedule.shape.offsets), (features, offsets), "{preset}");
        assert_eq!(schedule.begins_colored, preset != Preset::Paper, "{preset}");
        assert_eq!(schedule.max_anchors, max_anchors, "{preset}");

        // Enough for every phase of the schedule to begin.
        let options = TrainOptions { preset, iterations: Some(40), ..TrainOptions::default() };
        let (output, decoded) = run(&options);
        assert_eq!(output.metrics.steps, 40, "{preset}");
        let scene = &decoded.scene;
        let choices = &decoded.manifest.provenance.settings["choices"];
        let narrowed_from = choices.get("narrowed_from").map(|from| (&from["features"], &from["offsets"]));
        if preset == Preset::Paper {
            assert_eq!(
                (narrowed_from, scene.feature_dim, scene.offsets_per_anchor),
                (None, features, offsets)
            );
        } else {
            assert_eq!(narrowed_from, Some((&json!(features), &json!(offsets))), "{preset}");
            assert!((1..features).contains(&scene.feature_dim), "{preset}: {}", scene.feature_dim);
            assert!((1..=offsets).contains(&scene.offsets_per_anchor), "{preset}");
        }
        assert_eq!(decoded.manifest.provenance.settings["preset"], preset.to_string());
        decoded.scene.check().expect("a sound scene");
        assert!(output.metrics.test.psnr.is_some_and(f64::is_finite), "{preset}");
    }
}

#[test]
fn every_part_can_be_left_out_and_compressed_planes_be_asked_for() {
    let whole = TrainOptions { iterations: Some(40), ..TrainOptions::default() };
    let (usual, _) = run(&whole);
    let with = TrainOptions { with: [Component::PlaneCompression].into(), ..whole.clone() };
    let mut variants = vec![with];
    let parts = [Component::TriPlane, Component::Knn, Component::Wavelet, Component::Masks, Component::Basis];
    variants.extend(parts.map(|part| TrainOptions { without: [part].into(), ..whole.clone() }));
    for options in variants {
        let (output, decoded) = run(&options);
        assert!(output.file != usual.file, "nothing differs: {options:?}");
        let mut settings = decoded.manifest.provenance.settings.clone();
        let choices = settings.as_object_mut().and_then(|settings| settings.remove("choices"));
        let choices: Choices = serde_json::from_value(choices.expect("choices")).expect("choices");
        assert_eq!(choices.max_anchors_by, SizeBound::Preset);
        let stated: TrainOptions = serde_json::from_value(settings.clone()).expect("options");
        assert_eq!((&stated.with, &stated.without), (&options.with, &options.without), "{settings}");
        decoded.scene.check().expect("a sound scene");
        let contexts = inspect(&output.file).expect("inspects").manifest.contexts;
        assert_eq!(
            contexts.map(|context| context.kind),
            decoded.manifest.contexts.map(|context| context.kind)
        );
    }
}
