//! How many steps are sent to the device before it is waited for.

/// The number of steps in a batch; what comes of them does not depend on it.
#[derive(Debug, Clone, Copy)]
pub(super) enum Batch {
    /// As many as take about a second, so that a cancelled run stops soon and little has to be done again. Where a second is more
    /// than `REPORT_EVERY` steps, those end the batch: reports and the weight of the rate go by steps, not by time, so that runs
    /// repeat.
    Timed { seconds_a_step: f64 },
    /// That many.
    #[cfg(test)]
    Fixed(usize),
}

impl Batch {
    pub(super) fn length(self) -> usize {
        match self {
            Batch::Timed { seconds_a_step } => (1.0 / seconds_a_step.max(1e-6)).max(1.0) as usize,
            #[cfg(test)]
            Batch::Fixed(length) => length,
        }
    }

    /// Takes notice of the time that some steps took.
    pub(super) fn learn(&mut self, steps: u32, seconds: f64) {
        match self {
            Batch::Timed { seconds_a_step } => *seconds_a_step = seconds / f64::from(steps.max(1)),
            #[cfg(test)]
            Batch::Fixed(_) => {}
        }
    }
}
