//! The number of steps that are submitted to the device before the host waits for them.

/// Steps between two reports of progress, and so the largest number of steps in flight.
pub(super) const REPORT_INTERVAL: u32 = 10;

/// The length of a batch; results do not depend on it.
#[derive(Debug, Clone, Copy)]
pub(super) enum Batch {
    /// About a second, so that a cancelled run stops soon and an overflow repeats little. Batches end at multiples of
    /// [`REPORT_INTERVAL`] in any case: reports and lambda are updated by step number, not by time, so that runs are reproducible.
    Timed { seconds_per_step: f64 },
    /// A fixed number of steps.
    #[cfg(test)]
    Fixed(usize),
}

impl Batch {
    pub(super) fn length(self) -> usize {
        match self {
            Batch::Timed { seconds_per_step } => (1.0 / seconds_per_step.max(1e-6)).max(1.0) as usize,
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
