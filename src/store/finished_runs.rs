//! How fast finished jobs trained, for estimates of others.

/// A finished job, as an estimate looks at it.
#[derive(Debug, Clone, PartialEq)]
pub struct FinishedRun {
    /// Adapter and driver that trained.
    pub adapter: String,
    /// Mean pixels of a training photograph.
    pub view_pixels: u64,
    /// Training steps a second over the whole run.
    pub steps_per_second: f64,
    /// Seconds from the start to the end that were not training; `None` if there was more than one attempt,
    /// and for jobs whose cameras were found or that have several files.
    pub other_seconds: Option<f64>,
}

/// How many of the newest jobs [`super::Store::finished_runs`] looks at.
pub const RUNS_LOOKED_AT: u32 = 200;
