//! Saves checkpoints of a run while it goes on.

use super::{super::CheckpointSink, Run};
use crate::domain::Progress;

/// Saves checkpoints of a run, at most one per step.
pub(super) struct CheckpointWriter<'a> {
    pub(super) sink: Option<&'a mut dyn CheckpointSink>,
    /// Step of the newest checkpoint.
    pub(super) saved_step: u32,
}

impl CheckpointWriter<'_> {
    pub(super) fn wants(&mut self, step: u32) -> bool {
        self.sink.as_mut().is_some_and(|sink| sink.wants(step))
    }

    /// The report, with the step of the newest checkpoint.
    pub(super) fn with_checkpoint_step(&self, progress: Progress) -> Progress {
        Progress { checkpoint_step: u64::from(self.saved_step), ..progress }
    }

    /// Saves the state of a run that was resumed from elsewhere, so that the next interruption finds it.
    pub(super) fn keep_first(&mut self, run: &Run) {
        if self.sink.as_ref().is_some_and(|sink| !sink.has_one()) {
            self.saved_step = 0;
            self.save(run);
        }
    }

    /// Saves the run's state. A failure is only logged: the run can continue without a checkpoint.
    pub(super) fn save(&mut self, run: &Run) {
        let step = run.state.step;
        let Some(sink) = self.sink.as_mut().filter(|_| step != self.saved_step) else { return };
        match run.checkpoint().and_then(|checkpoint| Ok(sink.save(&checkpoint)?)) {
            Ok(()) => self.saved_step = step,
            Err(error) => tracing::warn!(step, "checkpoint of step {step} not saved: {error}"),
        }
    }
}
