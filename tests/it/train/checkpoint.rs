//! Runs that are interrupted and go on end with the bits of those that were not.

use std::{collections::BTreeMap, path::Path, sync::Arc};

use jiff::{SignedDuration, Timestamp};
use safetensors::SafeTensors;
use serde_json::Value;
use tcgs::{
    domain::{CancelFlag, Dataset, Digest, ManualClock, ModelKind, Problem, Progress, TrainOptions},
    train::{
        Checkpoint, CheckpointError, CheckpointFolder, CheckpointSink, Checkpoints, TrainError, Trained,
        Trainer,
    },
};

use crate::{
    support::gpu::gpu,
    train::training::{dataset, options, scaled},
};

/// Growth comes every 25 steps from a twentieth of the run to its half: here at 25 and 50; its statistics begin
/// anew with each round.
const STEPS: u32 = 104;

/// The first step; before growth, at it, between two rounds with statistics gathered, at the second round and right after
/// it; when growth is over; and the last step. Of compression: when noise begins and after it, when the context model
/// begins and after it, while planes are reconstructed, when masks settle, when everything is rounded and after it.
const INTERRUPTED: [u32; 13] = [1, 10, 17, 25, 35, 40, 50, 51, 60, 78, 88, 95, STEPS];

/// Those before masks settle and before everything is rounded, whose pauses may be long: kept in any case.
const BEFORE_PAUSES: [u32; 2] = [77, 87];

/// Keeps the checkpoints of the steps that a test wants.
struct Kept {
    wants: fn(u32) -> bool,
    checkpoints: BTreeMap<u32, Checkpoint>,
}

impl Kept {
    fn at(wants: fn(u32) -> bool) -> Self {
        Self { wants, checkpoints: BTreeMap::new() }
    }

    fn steps(&self) -> Vec<u32> {
        self.checkpoints.keys().copied().collect()
    }
}

impl CheckpointSink for Kept {
    fn wants(&mut self, step: u32) -> bool {
        (self.wants)(step)
    }

    fn save(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError> {
        // Through the bytes of a file, as every checkpoint goes that is read again.
        let read = Checkpoint::from_bytes(&bytes(checkpoint))?;
        let doubled = self.checkpoints.insert(checkpoint.step(), read);
        assert!(doubled.is_none(), "step {} is kept twice", checkpoint.step());
        Ok(())
    }
}

fn bytes(checkpoint: &Checkpoint) -> Vec<u8> {
    let mut bytes = Vec::new();
    checkpoint.write(&mut bytes).expect("memory takes it");
    bytes
}

fn outcome(
    dataset: &Dataset,
    options: &TrainOptions,
    checkpoints: Checkpoints<'_>,
) -> Result<(Trained, Vec<Progress>), TrainError> {
    let mut reports = Vec::new();
    let mut report = |progress: &Progress| reports.push(progress.clone());
    let trained = Trainer::new(&gpu(), dataset, options).with_checkpoints(checkpoints).run(&mut report)?;
    Ok((trained, reports))
}

fn resumed(checkpoint: &Checkpoint, options: &TrainOptions) -> (Trained, Vec<Progress>) {
    let checkpoints = Checkpoints { resume: Some(checkpoint.clone()), sink: None };
    outcome(&dataset(), options, checkpoints).expect("resumes")
}

/// Everything of a report that does not depend on the machine's speed.
fn figures(progress: &Progress) -> ([u64; 4], [Option<u64>; 3]) {
    let bits = |value: Option<f64>| value.map(f64::to_bits);
    let Progress { step, total, anchors, gaussians, loss, psnr, bytes, .. } = progress;
    ([*step, *total, *anchors, *gaussians], [bits(*loss), bits(*psnr), *bytes])
}

#[test]
fn a_run_that_goes_on_from_any_step_ends_with_the_same_bits() {
    let options = options(STEPS, 7);
    let mut kept = Kept::at(|step| INTERRUPTED.contains(&step));
    let checkpoints = Checkpoints { resume: None, sink: Some(&mut kept) };
    let (whole, reports) = outcome(&dataset(), &options, checkpoints).expect("a scene");
    let mut expected = [&INTERRUPTED[..], &BEFORE_PAUSES].concat();
    expected.sort_unstable();
    assert_eq!(kept.steps(), expected);
    let context = whole.context.as_ref().expect("a context model");
    let candidates = &context.candidates;
    assert!(candidates.position[0].is_some() || candidates.planes.len() == 1, "one model is chosen");
    assert!(reports.iter().any(|report| report.bytes.is_some()), "sizes are estimated");
    let grown: std::collections::BTreeSet<u64> = reports.iter().map(|report| report.anchors).collect();
    assert!(grown.len() >= 3, "two rounds of growth are part of the test: {grown:?}");
    for (step, checkpoint) in &kept.checkpoints {
        let (trained, later) = resumed(checkpoint, &options);
        assert!(trained.scene == whole.scene, "another scene after step {step}");
        assert!(trained.context == whole.context, "another context after step {step}");
        assert_eq!(trained.steps, STEPS);
        assert!(trained.seconds > 0.0);
        assert_eq!(later[0].step, u64::from(*step), "the first report states the resumed step");
        let values = |reports: &[Progress]| -> Vec<_> {
            reports.iter().filter(|report| report.step > u64::from(*step)).map(figures).collect()
        };
        assert_eq!(values(&later), values(&reports), "different values after step {step}");
    }
}

#[test]
fn a_run_of_plain_gaussians_goes_on_from_any_step_too() {
    let options = TrainOptions { model: ModelKind::Gaussians3d, ..options(STEPS, 7) };
    let mut kept = Kept::at(|step| [1, 40, 60, STEPS].contains(&step));
    let checkpoints = Checkpoints { resume: None, sink: Some(&mut kept) };
    let (whole, _) = outcome(&dataset(), &options, checkpoints).expect("a scene");
    for (step, checkpoint) in &kept.checkpoints {
        assert!(resumed(checkpoint, &options).0.scene == whole.scene, "another scene after step {step}");
    }
}

#[test]
fn a_run_that_prunes_to_a_number_goes_on_between_its_rounds() {
    let plain = TrainOptions { model: ModelKind::Gaussians3d, ..options(STEPS, 7) };
    let options = TrainOptions { target_gaussians: Some(50), ..plain };
    // Rounds are from half to three quarters of the run.
    let mut kept = Kept::at(|step| [STEPS / 2, STEPS / 2 + 1, STEPS * 5 / 8, STEPS].contains(&step));
    let checkpoints = Checkpoints { resume: None, sink: Some(&mut kept) };
    let (whole, reports) = outcome(&dataset(), &options, checkpoints).expect("a scene");
    assert_eq!(reports.last().map(|report| report.gaussians), Some(50));
    for (step, checkpoint) in &kept.checkpoints {
        assert!(resumed(checkpoint, &options).0.scene == whole.scene, "another scene after step {step}");
    }
}

#[test]
fn a_run_from_random_points_goes_on_from_either_of_its_stages() {
    // In another frame than the world's; plain Gaussians up to step 18.
    let dataset = Dataset { points: None, ..scaled(&dataset(), 1e-3) };
    // A shorter run often keeps nothing.
    let options = options(90, 11);
    let mut kept = Kept::at(|step| [4, 17, 18, 19, 60].contains(&step));
    let checkpoints = Checkpoints { resume: None, sink: Some(&mut kept) };
    let (whole, reports) = outcome(&dataset, &options, checkpoints).expect("a scene");
    assert!(!whole.scene.frame().is_world());
    assert!(reports.iter().all(|report| report.gaussians > 0));
    for (step, checkpoint) in &kept.checkpoints {
        let checkpoints = Checkpoints { resume: Some(checkpoint.clone()), sink: None };
        let (resumed, _) = outcome(&dataset, &options, checkpoints).expect("resumes");
        assert!(resumed.scene == whole.scene, "another scene after step {step}");
    }
}

#[test]
fn a_run_goes_on_in_its_frame() {
    let (tiny, options) = (scaled(&dataset(), 1e-3), options(32, 7));
    let mut kept = Kept::at(|step| [3, 30].contains(&step));
    let checkpoints = Checkpoints { resume: None, sink: Some(&mut kept) };
    let (whole, _) = outcome(&tiny, &options, checkpoints).expect("a scene");
    assert!(!whole.scene.frame().is_world());
    for (step, checkpoint) in &kept.checkpoints {
        let checkpoints = Checkpoints { resume: Some(checkpoint.clone()), sink: None };
        let (resumed, _) = outcome(&tiny, &options, checkpoints).expect("resumes");
        assert!(resumed.scene == whole.scene, "another scene after step {step}");
    }
}

#[test]
fn what_is_kept_does_not_depend_on_what_was_kept_before() {
    let options = options(32, 3);
    let mut often = Kept::at(|_| true);
    let mut seldom = Kept::at(|step| step == 27);
    let scenes = [&mut often as &mut dyn CheckpointSink, &mut seldom].map(|keep| {
        let checkpoints = Checkpoints { resume: None, sink: Some(keep) };
        outcome(&dataset(), &options, checkpoints).expect("a scene").0.scene
    });
    let without = outcome(&dataset(), &options, Checkpoints::default()).expect("a scene").0.scene;
    assert!(scenes[0] == without && scenes[1] == without, "checkpoints change the scene");
    assert_eq!(often.steps(), (1..=32).collect::<Vec<_>>());
    assert_eq!(seldom.steps(), [23, 26, 27, 32], "those before pauses and the last are kept in any case");
    for step in seldom.steps() {
        let [a, b] = [&often, &seldom].map(|kept| bytes(&kept.checkpoints[&step]));
        assert_eq!(contents(&a), contents(&b), "step {step}");
    }
}

/// The run's state without its time, and the tensors.
fn contents(bytes: &[u8]) -> (Value, BTreeMap<String, Vec<u8>>) {
    let (_, header) = SafeTensors::read_metadata(bytes).expect("a header");
    let run = &header.metadata().as_ref().expect("metadata")["run"];
    let mut run: Value = serde_json::from_str(run).expect("JSON");
    let seconds = run.as_object_mut().and_then(|run| run.remove("seconds")).expect("a time");
    assert!(seconds.as_f64() > Some(0.0));
    let tensors = SafeTensors::deserialize(bytes).expect("tensors").tensors();
    (run, tensors.into_iter().map(|(name, tensor)| (name, tensor.data().to_vec())).collect())
}

#[test]
fn a_cancelled_run_leaves_a_checkpoint_of_its_last_step() {
    let options = options(30, 1);
    let (whole, _) = outcome(&dataset(), &options, Checkpoints::default()).expect("a scene");
    let mut kept = Kept::at(|_| false);
    let cancel = CancelFlag::default();
    let mut report = |_: &Progress| cancel.cancel();
    let checkpoints = Checkpoints { resume: None, sink: Some(&mut kept) };
    let (gpu, dataset) = (gpu(), dataset());
    let trainer = Trainer::new(&gpu, &dataset, &options).cancelled_by(&cancel);
    let stopped = trainer.with_checkpoints(checkpoints).run(&mut report);
    assert!(matches!(stopped, Err(TrainError::Cancelled)));
    assert_eq!(kept.steps(), [10], "cancelled at the first report");
    let checkpoint = &kept.checkpoints[&10];
    assert!(resumed(checkpoint, &options).0.scene == whole.scene);

    // A run that is cancelled before its first step saves no checkpoint.
    let mut again = Kept::at(|_| true);
    let checkpoints = Checkpoints { resume: Some(checkpoint.clone()), sink: Some(&mut again) };
    let trainer = Trainer::new(&gpu, &dataset, &options).cancelled_by(&cancel);
    let stopped = trainer.with_checkpoints(checkpoints).run(|_| ());
    assert!(matches!(stopped, Err(TrainError::Cancelled)));
    assert!(again.steps().is_empty());
}

/// One checkpoint of a run of two steps, kept through `keep` as well.
fn first_step(options: &TrainOptions) -> Checkpoint {
    let mut kept = Kept::at(|step| step == 1);
    let checkpoints = Checkpoints { resume: None, sink: Some(&mut kept) };
    outcome(&dataset(), options, checkpoints).expect("a scene");
    kept.checkpoints.remove(&1).expect("the first step")
}

#[test]
fn checkpoints_of_other_runs_are_refused_before_the_first_step() {
    let checkpoint = first_step(&options(2, 5));
    let refused = |dataset: &Dataset, options: &TrainOptions| {
        let checkpoints = Checkpoints { resume: Some(checkpoint.clone()), sink: None };
        match outcome(dataset, options, checkpoints) {
            Err(TrainError::Checkpoint(error)) => error,
            other => panic!("not refused: {other:?}"),
        }
    };
    let error = refused(&dataset(), &options(2, 6));
    assert!(error.to_string().contains("seed is 5 in the checkpoint and 6 here"), "{error}");
    let error = refused(&dataset(), &options(3, 5));
    assert!(error.to_string().contains("iterations is 2 in the checkpoint and 3 here"), "{error}");
    assert_eq!(Problem::from(error).status, 422);
    let other = Dataset { digest: Digest::of(b"other"), ..dataset() };
    assert!(matches!(refused(&other, &options(2, 5)), CheckpointError::Dataset { .. }));
}

#[test]
fn a_checkpoint_that_cannot_be_kept_does_not_end_the_run() {
    struct Full(u32);
    impl CheckpointSink for Full {
        fn wants(&mut self, _: u32) -> bool {
            true
        }

        fn save(&mut self, _: &Checkpoint) -> Result<(), CheckpointError> {
            self.0 += 1;
            let error = std::io::ErrorKind::StorageFull.into();
            Err(CheckpointError::Io { path: "somewhere".into(), error })
        }
    }
    let mut full = Full(0);
    let checkpoints = Checkpoints { resume: None, sink: Some(&mut full) };
    outcome(&dataset(), &options(3, 0), checkpoints).expect("a scene all the same");
    assert_eq!(full.0, 3);
}

#[test]
fn a_folder_holds_the_newest_checkpoint_and_refuses_what_is_none() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("new/checkpoints");
    assert!(matches!(CheckpointFolder::load(&path), Err(CheckpointError::Missing(_))));
    let clock = Arc::new(ManualClock::new(Timestamp::UNIX_EPOCH));
    let mut keep = CheckpointFolder::open(&path, clock.clone()).expect("opens");
    assert!(!keep.wants(1));
    clock.advance(SignedDuration::from_secs(59));
    assert!(!keep.wants(2));
    clock.advance(SignedDuration::from_secs(1));
    assert!(keep.wants(3));
    let checkpoint = first_step(&options(2, 5));
    for checkpoint in [&first_step(&options(2, 4)), &checkpoint] {
        keep.save(checkpoint).expect("saved");
        assert!(!keep.wants(4), "the next one has time");
        assert!(CheckpointFolder::load(&path).expect("loads") == *checkpoint);
    }
    let files: Vec<_> =
        std::fs::read_dir(&path).expect("a folder").map(|e| e.expect("an entry").path()).collect();
    assert_eq!(files.len(), 1, "one file and nothing beside it: {files:?}");
    clock.advance(SignedDuration::from_secs(-3600));
    assert!(keep.wants(5), "a clock that was set back does not put checkpoints off");

    let whole = std::fs::read(&files[0]).expect("a file");
    std::fs::write(&files[0], &whole[..whole.len() - 1]).expect("writes");
    assert!(matches!(CheckpointFolder::load(&path), Err(CheckpointError::Format(_))));
    let mut changed = whole.clone();
    changed[whole.len() - 9] ^= 4;
    std::fs::write(&files[0], &changed).expect("writes");
    assert!(matches!(CheckpointFolder::load(&path), Err(CheckpointError::Damaged { .. })));
    let file = folder.path().join("a file");
    std::fs::write(&file, "in the way").expect("writes");
    assert!(CheckpointFolder::open(&file, clock).is_err());
    assert!(CheckpointFolder::load(Path::new(&file)).is_err());
}
