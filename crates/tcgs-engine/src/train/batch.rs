//! Batches of steps: how many are submitted at a time, and what is known of those in flight.

use super::{checkpoint::RunState, loss::PartialSums};
use crate::gpu::Readback;

/// Steps between two reports of progress, and so the largest number of steps in a batch.
pub(super) const REPORT_INTERVAL: u32 = 10;

/// The length of a batch; results do not depend on it.
#[derive(Debug, Clone, Copy)]
pub(super) enum Batch {
    /// About half a second, so that a cancelled run, with two batches in flight, stops soon and an overflow repeats little. Batches end
    /// at multiples of [`REPORT_INTERVAL`] in any case: reports and lambda are updated by step number, not by time, so that runs are
    /// reproducible.
    Timed { seconds_per_step: f64 },
    /// A fixed number of steps.
    #[cfg(test)]
    Fixed(usize),
}

impl Batch {
    pub(super) fn length(self) -> usize {
        match self {
            Batch::Timed { seconds_per_step } => (0.5 / seconds_per_step.max(1e-6)).max(1.0) as usize,
            #[cfg(test)]
            Batch::Fixed(length) => length,
        }
    }

    /// Updates the estimate from the measured time of some steps.
    pub(super) fn update(&mut self, steps: u32, seconds: f64) {
        match self {
            Batch::Timed { seconds_per_step } => *seconds_per_step = seconds / f64::from(steps.max(1)),
            #[cfg(test)]
            Batch::Fixed(_) => {}
        }
    }
}

/// A batch that was submitted and not settled yet.
pub(super) struct Flight {
    /// The state before each of its steps.
    pub before: Vec<RunState>,
    /// Its last step.
    pub last: u32,
    /// Whether the figures of that step are reported once it is settled.
    pub is_reported: bool,
    /// Where the losses of that step are.
    pub losses: Option<PartialSums>,
    /// The rasterizer's counters after that step, then its figures if they are reported.
    pub reading: Readback,
}
