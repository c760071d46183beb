//! Measures how fast a job's first steps are on this machine.
//!
//! A few of the training photographs are read and the job's own run is begun on them, as it would begin; nothing is kept of it.

use std::{
    path::Path,
    time::{Duration, Instant},
};

use super::{Pipeline, error::JobError};
use crate::{
    domain::{CancelFlag, Exposure, TrainOptions, ValueRange},
    ingest::{self, LoadBudget},
    train::{Checkpoint, CheckpointError, CheckpointSink, Checkpoints, TrainError, Trainer},
};

/// Training photographs that are read: a step costs the same however many there are.
const PHOTOGRAPHS: usize = 24;

/// The step whose recording starts the clock: the step before the last one, which compiled the kernels, has ended then.
const FIRST_TIMED: u32 = 3;

/// How many times as long a step of a whole run takes in the mean as one of its first: in runs of fewer than [`LONG_RUN`] steps, and in
/// longer ones, whose models have more time to grow. Ratios of recorded runs are 0.35 to 2.1, and 0.78 to 1.9 (docs/CLI.md).
const RUN_OVER_START: [ValueRange<f64>; 2] =
    [ValueRange { low: 0.3, high: 2.5 }, ValueRange { low: 0.7, high: 3.0 }];

/// The fewest steps of a long run.
const LONG_RUN: u64 = 1000;

/// How fast the first steps of a job were.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// Adapter, driver and backend.
    pub adapter: String,
    /// Steps that were timed.
    pub steps: u32,
    /// What they took.
    pub seconds: f64,
}

impl Calibration {
    /// Steps a second.
    #[must_use]
    pub fn steps_per_second(&self) -> f64 {
        f64::from(self.steps) / self.seconds.max(1e-9)
    }

    /// The seconds that a run of `steps` steps takes.
    #[must_use]
    pub fn train_seconds(&self, steps: u64) -> ValueRange<f64> {
        let at_first = steps as f64 / self.steps_per_second();
        let ratio = RUN_OVER_START[usize::from(steps >= LONG_RUN)];
        ValueRange { low: at_first * ratio.low, high: at_first * ratio.high }
    }
}

impl Pipeline {
    /// Times the first steps of a job for about `limit`, or for a few steps if one takes longer. Kernels are compiled before that.
    ///
    /// # Errors
    /// As a job; [`JobError::Cancelled`] if the run had too few steps to time one, or `cancel` was set.
    pub fn calibrate(
        &self,
        dataset: &Path,
        options: &TrainOptions,
        limit: Duration,
        cancel: &CancelFlag,
    ) -> Result<Calibration, JobError> {
        let device = self.device()?;
        let budget = self.budget(&device);
        let load_budget = LoadBudget { memory_bytes: budget.host / 2, spill_dir: self.spill_dir.clone() };
        let go_on = || !cancel.is_cancelled();
        let dataset = ingest::load_sample(dataset, &options.reading(), PHOTOGRAPHS, &load_budget, &go_on)?;
        let options = timed_options(options);
        let stop = CancelFlag::default();
        let mut timer = Timer { limit, stop: &stop, cancel, started: None, ended: None };
        let checkpoints = Checkpoints { resume: None, sink: Some(&mut timer) };
        let trainer = Trainer::new(&device, &dataset, &options).within(budget).cancelled_by(&stop);
        match trainer.with_checkpoints(checkpoints).run(|_| {}) {
            Ok(_) | Err(TrainError::Cancelled) => {}
            Err(error) => return Err(error.into()),
        }
        let (steps, seconds) = timer.ended.filter(|_| !cancel.is_cancelled()).ok_or(JobError::Cancelled)?;
        Ok(Calibration { adapter: device.adapter_line(), steps, seconds })
    }
}

/// The options of the run whose first steps are timed: of several branches the first, and without the trial of `exposure=auto`, which comes
/// before the first step and takes up to 200 steps of its own.
fn timed_options(options: &TrainOptions) -> TrainOptions {
    let options = options.branches().swap_remove(0);
    let exposure = if options.exposure == Exposure::Auto { Exposure::Off } else { options.exposure };
    TrainOptions { exposure, ..options }
}

/// Stops a run after some time, and counts its steps by the checkpoint that a stopped run saves.
struct Timer<'a> {
    limit: Duration,
    stop: &'a CancelFlag,
    cancel: &'a CancelFlag,
    started: Option<Instant>,
    /// Timed steps and their seconds.
    ended: Option<(u32, f64)>,
}

impl CheckpointSink for Timer<'_> {
    fn wants(&mut self, step: u32) -> bool {
        if step == FIRST_TIMED {
            self.started.get_or_insert_with(Instant::now);
        }
        if self.cancel.is_cancelled() || self.started.is_some_and(|started| started.elapsed() >= self.limit) {
            self.stop.cancel();
        }
        false
    }

    fn save(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError> {
        let steps = checkpoint.step().saturating_sub(FIRST_TIMED - 2);
        if let Some(started) = self.started
            && steps > 0
        {
            // The latest: a run is saved before its pauses too.
            self.ended = Some((steps, started.elapsed().as_secs_f64()));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_trial_of_color_corrections_comes_before_the_timed_steps() {
        let options = |exposure| TrainOptions { exposure, ..TrainOptions::default() };
        for (asked, timed) in
            [(Exposure::Auto, Exposure::Off), (Exposure::Off, Exposure::Off), (Exposure::On, Exposure::On)]
        {
            assert_eq!(timed_options(&options(asked)), options(timed));
        }
    }

    #[test]
    fn a_range_has_the_ratios_of_recorded_runs() {
        // Steps a second at first, steps of the run, steps a second of the run.
        for (at_first, steps, mean) in
            [(4.09, 300, 9.23), (6.10, 600, 2.95), (8.48, 2000, 4.48), (5.47, 2000, 5.73)]
        {
            let calibration = Calibration { adapter: String::new(), steps: 100, seconds: 100.0 / at_first };
            let ValueRange { low, high } = calibration.train_seconds(steps);
            let took = steps as f64 / mean;
            assert!((low..=high).contains(&took), "{took} s of {low}..={high}");
        }
    }
}
