//! Runs that may stop once they have converged: earlier if views kept aside stop gaining, and with the same bits after an interruption.

use std::{collections::BTreeMap, sync::Arc};

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::{
        Camera, Convergence, Dataset, Digest, Frame, Image, Intrinsics, Layout, ModelKind, Photograph,
        PhotographError, PixelSource, PointCloud, Pose, Split, TrainOptions, Until,
    },
    train::{Checkpoint, CheckpointError, CheckpointSink, Checkpoints, Schedule, Trained, Trainer},
};

use crate::support::gpu::gpu;

const STEPS: u32 = 150;
const SIZE: [u32; 2] = [24, 16];

/// Pixels that nothing may read.
#[derive(Debug)]
struct HeldOut;

impl PixelSource for HeldOut {
    fn samples(&self) -> Result<Vec<u8>, PhotographError> {
        panic!("training read a held-out photograph");
    }
}

/// Photographs of noise, so that no view tells anything of another one, and held-out ones that cannot be read.
fn dataset(training: u32) -> Dataset {
    let mut rng = Pcg64::seed_from_u64(1);
    let [width, height] = SIZE;
    let frames = (0..training + 2).map(|index| {
        let turn = f64::from(index);
        let eye = DVec3::new(3.0 * turn.cos(), 3.0 * turn.sin(), 1.0);
        let pose = Pose::look_at(eye, DVec3::ZERO, DVec3::Z).expect("a view");
        let intrinsics = Intrinsics { fx: 20.0, fy: 20.0, cx: 12.0, cy: 8.0, width, height };
        let split = if index < training { Split::Train } else { Split::Test };
        let image = match split {
            Split::Test => Photograph::stored((width, height, 3), Arc::new(HeldOut)),
            _ => {
                let samples = (0..width * height * 3).map(|_| rng.random()).collect();
                Image::new(width, height, 3, samples).expect("an image").into()
            }
        };
        let camera = Camera::new(intrinsics, pose).expect("a camera");
        Frame { name: format!("{index:02}"), camera, image, split }
    });
    let frames = frames.collect();
    let positions: Vec<[f64; 3]> = (0..60).map(|_| [0; 3].map(|_| rng.random_range(-1.0..1.0))).collect();
    Dataset {
        layout: Layout::Colmap,
        frames,
        points: Some(PointCloud { colors: vec![[128; 3]; positions.len()], positions }),
        digest: Digest::of(b"noise"),
        notes: Vec::new(),
    }
}

#[derive(Default)]
struct Kept(BTreeMap<u32, Checkpoint>);

impl CheckpointSink for Kept {
    fn wants(&mut self, step: u32) -> bool {
        step.is_multiple_of(25)
    }

    fn save(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError> {
        // Through the bytes of a file, as every checkpoint goes that is read again.
        let mut bytes = Vec::new();
        checkpoint.write(&mut bytes).expect("memory takes it");
        self.0.insert(checkpoint.step(), Checkpoint::from_bytes(&bytes)?);
        Ok(())
    }
}

fn options(model: ModelKind, until: Until) -> TrainOptions {
    TrainOptions { model, until, iterations: Some(STEPS), seed: 3, ..TrainOptions::default() }
}

fn trained(dataset: &Dataset, options: &TrainOptions, checkpoints: Checkpoints<'_>) -> Trained {
    Trainer::new(&gpu(), dataset, options).with_checkpoints(checkpoints).run(|_| {}).expect("a scene")
}

/// What does not depend on the machine's speed.
fn without_seconds(trained: &Trained) -> Convergence {
    let convergence = trained.convergence.clone().expect("reported");
    Convergence { seconds_saved: 0.0, ..convergence }
}

#[test]
fn a_run_that_no_longer_gains_ends_early_and_also_after_an_interruption_with_the_same_bits() {
    let dataset = dataset(10);
    for model in ModelKind::ALL {
        let options = options(model, Until::Converged);
        let mut kept = Kept::default();
        let whole = trained(&dataset, &options, Checkpoints { resume: None, sink: Some(&mut kept) });
        let report = without_seconds(&whole);
        assert_eq!(report.views, ["05"], "{model}");
        let after = u32::try_from(report.converged_at.expect("noise cannot be foretold")).expect("a step");
        let steps = after + (STEPS - after).div_ceil(3);
        assert_eq!((whole.steps, report.steps_saved), (steps, u64::from(STEPS - steps)), "{model}");
        assert!(
            kept.0.keys().any(|step| *step < after) && kept.0.keys().any(|step| *step > after),
            "{model}"
        );
        for (step, checkpoint) in kept.0 {
            let resumed = Checkpoints { resume: Some(checkpoint), sink: None };
            let again = trained(&dataset, &options, resumed);
            assert!(again.scene == whole.scene, "{model}: another scene after step {step}");
            assert!(again.context == whole.context, "{model}: another context after step {step}");
            assert_eq!(without_seconds(&again), report, "{model}: after step {step}");
        }
    }
}

#[test]
fn a_set_with_too_few_views_is_trained_in_full_with_the_bits_of_a_full_run() {
    let dataset = dataset(7);
    let [full, converged] = [Until::Full, Until::Converged]
        .map(|until| trained(&dataset, &options(ModelKind::Tcgs, until), Checkpoints::default()));
    assert!(full.scene == converged.scene && full.context == converged.context);
    assert_eq!(full.convergence, None);
    let report = without_seconds(&converged);
    assert!(report.views.is_empty() && report.scores.is_empty());
    assert_eq!((report.converged_at, report.steps_saved, converged.steps), (None, 0, STEPS));
}

#[test]
fn every_window_and_learning_rate_of_a_hastened_schedule_ends_where_the_full_one_does() {
    for model in ModelKind::ALL {
        let full = Schedule::new(&TrainOptions { model, ..TrainOptions::default() });
        for after in [200, 500, 900, 1799] {
            let schedule = full.hastened_after(after);
            assert_eq!(schedule.steps, after + (full.steps - after).div_ceil(3));
            assert_eq!(schedule.fraction(schedule.steps), 1.0);
            assert!((1..=after).all(|step| schedule.fraction(step) == full.fraction(step)));
            assert!((1..after).all(|step| schedule.densifies(step) == full.densifies(step)));
            if let (Some(masks), Some(way)) = (schedule.masks, full.masks)
                && after < way.from
            {
                assert!(after < masks.from && masks.from < masks.until && masks.until < schedule.steps);
                let sum = |masks: &tcgs::train::MaskSchedule, schedule: &Schedule| -> f64 {
                    let steps = (1..=schedule.steps).filter(|step| masks.learns(*step));
                    steps.map(|step| masks.learning_rate.at(schedule.fraction(step))).sum()
                };
                let ratio = sum(&masks, &schedule) / sum(&way, &full);
                assert!((ratio - 1.0).abs() < 0.02, "logits come as far: {ratio}");
            }
            if let (Some(short), Some(long)) = (&schedule.compression, &full.compression) {
                assert!((1..schedule.steps).all(|step| short.stage(step) <= short.stage(step + 1)));
                assert_eq!(short.stage(schedule.steps), long.stage(full.steps));
                assert_eq!(short.context_progress(schedule.steps), 1.0);
                let progress = |step| short.context_progress(step);
                assert!((1..schedule.steps).all(|step| progress(step) <= progress(step + 1)));
            }
        }
    }
}
