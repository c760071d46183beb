//! Checkpoints: the state of a run between two steps, its file and its folder.
//!
//! Invariants: a run that resumes from a checkpoint of any of its steps ends with the same bits as one that was never interrupted;
//! a file that is truncated, changed or of another run is refused with what differs.

mod error;
mod file;
mod folder;
mod model_state;
mod run_state;

pub use error::CheckpointError;
pub use folder::{CheckpointFolder, CheckpointSink};
pub(super) use model_state::ModelState;
pub(super) use run_state::{RunIdentity, RunState};

use run_state::{differences, options_text};

use super::Schedule;
use crate::domain::{ExposureChoice, SceneFrame, TrainOptions};

/// Version of the file format.
const VERSION: &str = "1";

/// The program, whose schedule and arithmetic a run depends on.
const GENERATOR: &str = concat!("tcgs ", env!("CARGO_PKG_VERSION"));

/// The state of a run between two steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    run: RunState,
    model: ModelState,
}

impl Checkpoint {
    pub(super) fn new(run: RunState, model: ModelState) -> Self {
        Self { run, model }
    }

    /// Steps done.
    #[must_use]
    pub fn step(&self) -> u32 {
        self.run.step
    }

    /// The frame that its scene is trained in.
    pub(super) fn frame(&self) -> SceneFrame {
        self.run.frame()
    }

    /// Whether its run learns color corrections, and why.
    pub(super) fn exposure(&self) -> ExposureChoice {
        self.run.exposure()
    }

    /// The same state as a checkpoint of `branch`, one of the branches of the rate-distortion curve `trunk`. The branches differ only
    /// in lambda, which has no effect up to the fork.
    ///
    /// # Errors
    /// If it is a checkpoint of another run, or later than the fork.
    pub fn fork(mut self, trunk: &TrainOptions, branch: &TrainOptions) -> Result<Self, CheckpointError> {
        let expected = options_text(trunk);
        if self.run.options != expected {
            return Err(CheckpointError::Options(differences(&self.run.options, &expected)));
        }
        let text = options_text(branch);
        if !trunk.branches().iter().any(|known| options_text(known) == text) {
            return Err(CheckpointError::Options(differences(&expected, &text)));
        }
        let fork = Schedule::new(trunk).fork_step();
        if self.run.step > fork {
            let error = format!("step {} is after step {fork}, where branches fork", self.run.step);
            return Err(CheckpointError::Run(error));
        }
        self.run.options = text;
        self.run.lambda = Schedule::new(branch).lambda().to_bits();
        Ok(self)
    }

    /// The state to resume the run `identity` of `steps` steps over `frames` photographs from.
    ///
    /// # Errors
    /// What differs, if it is a checkpoint of another run.
    pub(super) fn open(
        self,
        identity: RunIdentity<'_>,
        steps: u32,
        frames: usize,
    ) -> Result<(RunState, ModelState), CheckpointError> {
        let run = self.run.at_full_length(steps);
        run.check(identity, steps, frames)?;
        Ok((run, self.model))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::{
        domain::{Digest, ExposureTrial, Preset},
        train::LossSums,
    };

    fn options() -> TrainOptions {
        TrainOptions { seed: 7, lambda: Some(0.1 + 0.2), ..TrainOptions::default() }
    }

    fn identity(options: &TrainOptions) -> RunIdentity<'_> {
        RunIdentity { options, dataset: Digest::of(b"set"), adapter: "an adapter", max_size: 1000 }
    }

    fn checkpoint() -> Checkpoint {
        let options = options();
        let mut rng = Pcg64::seed_from_u64(7);
        let _: u64 = rng.random();
        let frame = SceneFrame::new(glam::DVec3::new(0.1 + 0.2, -1e7, 0.0), 1.0 / 3.0).expect("a frame");
        let trial = ExposureTrial { views: 2, gain: 0.1 + 0.2, needed: 0.25 };
        let run = RunState::new(identity(&options), frame, rng, 0.002);
        let mut run = run.with_exposure(ExposureChoice::by(trial));
        run.step = 30;
        run.seconds = 12.5;
        run.order = vec![3, 0, 2];
        run.observe_losses(&LossSums { ssim: 0.1 + 0.2, l1: 1.0 / 3.0, mse: 1e-300, wavelet: 0.7 });
        let mut model = ModelState::default();
        model.put("rows", vec![1.0_f32, f32::MIN_POSITIVE / 2.0, -0.0]);
        model.put("cells", vec![-1, i32::MAX]);
        model.put("masks", vec![u32::MAX]);
        Checkpoint::new(run, model)
    }

    fn written(checkpoint: &Checkpoint) -> Vec<u8> {
        let mut bytes = Vec::new();
        checkpoint.write(&mut bytes).expect("writes");
        bytes
    }

    #[test]
    fn a_checkpoint_comes_back_bit_for_bit() {
        let bytes = written(&checkpoint());
        let back = Checkpoint::from_bytes(&bytes).expect("reads");
        assert_eq!(back, checkpoint());
        let trial = ExposureTrial { views: 2, gain: 0.1 + 0.2, needed: 0.25 };
        assert_eq!(back.exposure(), ExposureChoice { corrected: true, trial: Some(trial) });
        let options = options();
        let (mut run, _) = back.open(identity(&options), 30, 4).expect("of this run");
        let (mut other, _) = checkpoint().open(identity(&options), 30, 4).expect("of this run");
        assert_eq!(run.rng.random::<u64>(), other.rng.random::<u64>());
        assert_eq!(
            run.average(),
            Some(LossSums { ssim: 0.1 + 0.2, l1: 1.0 / 3.0, mse: 1e-300, wavelet: 0.7 })
        );
    }

    #[test]
    fn every_truncation_is_refused() {
        let bytes = written(&checkpoint());
        for length in 0..bytes.len() {
            assert!(Checkpoint::from_bytes(&bytes[..length]).is_err(), "cut to {length}");
        }
        assert!(matches!(Checkpoint::from_bytes(b"no checkpoint at all"), Err(CheckpointError::Format(_))));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(400))]

        #[test]
        fn every_flipped_bit_is_refused_or_changes_nothing(at in any::<prop::sample::Index>(), bit in 0..8_u32) {
            let mut bytes = written(&checkpoint());
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
            if let Ok(read) = Checkpoint::from_bytes(&bytes) {
                prop_assert_eq!(read, checkpoint());
            }
        }
    }

    #[test]
    fn checkpoints_of_other_runs_are_refused_with_what_differs() {
        let options = options();
        let refused = |identity: RunIdentity<'_>, steps, frames| {
            checkpoint().open(identity, steps, frames).expect_err("another run").to_string()
        };
        let other = TrainOptions { seed: 8, preset: Preset::Paper, ..options.clone() };
        let text = refused(identity(&other), 30, 4);
        assert!(text.contains("seed is 7 in the checkpoint and 8 here"), "{text}");
        assert!(text.contains(r#"preset is "preview" in the checkpoint and "paper" here"#), "{text}");
        let text = refused(RunIdentity { dataset: Digest::of(b"other"), ..identity(&options) }, 30, 4);
        assert!(text.contains(&Digest::of(b"other").to_string()), "{text}");
        assert!(refused(identity(&options), 29, 4).contains("step 30 is not one of 1 to 29"));
        assert!(refused(identity(&options), 30, 3).contains("photograph 3 of 3"));
        let elsewhere = RunIdentity { adapter: "another adapter", ..identity(&options) };
        assert!(checkpoint().open(elsewhere, 30, 4).is_ok(), "it may resume on another adapter");
        let mut moved = checkpoint().run;
        moved.continue_on("another adapter", 2000);
        assert_eq!((&*moved.adapter, moved.max_size), ("another adapter", 1000), "a larger limit is ignored");
        moved.continue_on("another adapter", 500);
        assert_eq!(moved.max_size, 500);
        let mut old = checkpoint();
        old.run.generator = "tcgs 0.0.1".to_owned();
        let error = old.open(identity(&options), 30, 4).expect_err("another program").to_string();
        assert!(error.contains("tcgs 0.0.1"), "{error}");
    }

    #[test]
    fn a_run_that_an_earlier_version_shortened_resumes_at_the_step_of_the_schedule_that_it_had_come_to() {
        let options = options();
        let resumed = |scores: &str, steps| {
            let run = serde_json::to_string(&checkpoint().run).expect("JSON");
            let run = format!("{},\"scores\":{scores}}}", run.trim_end_matches('}'));
            let run: RunState = serde_json::from_str(&run).expect("the state of an earlier version");
            Checkpoint::new(run, checkpoint().model).open(identity(&options), steps, 4).expect("resumes").0
        };
        let converged = r#"{"all":[[20,4628574517030027264]],"converged":{"step":20,"psnr":1,"gain":2}}"#;
        assert_eq!(resumed(converged, 60).step, 50, "10 of 30 steps at three times the pace");
        assert_eq!(resumed(converged, 45).step, 45, "its last step");
        let run = resumed(r#"{"all":[],"converged":null}"#, 60);
        assert_eq!(run.step, 30);
        assert_eq!(run, checkpoint().run, "nothing is left of it");
    }

    #[test]
    fn a_checkpoint_becomes_a_branchs_only_before_branches_part_and_only_a_branch_of_its_own() {
        let trunk =
            TrainOptions { lambda: None, iterations: Some(120), rd_curve: vec![0.004, 0.001], ..options() };
        let at = |step| {
            let mut checkpoint = checkpoint();
            checkpoint.run.options = options_text(&trunk);
            checkpoint.run.step = step;
            checkpoint
        };
        for branch in trunk.branches() {
            let fork = at(40).fork(&trunk, &branch).expect("a branch");
            fork.open(identity(&branch), 120, 4).expect("of the branch's run");
        }
        let branch = &trunk.branches()[0];
        let refused = |checkpoint: Checkpoint, trunk: &TrainOptions, branch: &TrainOptions| {
            checkpoint.fork(trunk, branch).expect_err("refused").to_string()
        };
        let late = refused(at(41), &trunk, branch);
        assert!(late.contains("step 41 is after step 40"), "{late}");
        for other in [
            TrainOptions { lambda: Some(0.002), ..branch.clone() },
            TrainOptions { seed: 8, ..branch.clone() },
        ] {
            refused(at(40), &trunk, &other);
        }
        refused(at(40), &TrainOptions { seed: 8, ..trunk.clone() }, branch);
        refused(checkpoint(), &trunk, branch);
    }

    #[test]
    fn another_version_of_the_layout_is_refused_by_its_number() {
        let mut bytes = written(&checkpoint());
        let key = br#""tcgs.checkpoint":""#;
        let place = bytes.windows(key.len()).position(|window| window == key);
        let at = place.expect("the version") + key.len();
        bytes[at] = b'9';
        let error = Checkpoint::from_bytes(&bytes).expect_err("refused");
        assert!(matches!(&error, CheckpointError::Version(version) if version == "9"), "{error}");
    }
}
