//! Statistics of the whole store, for metrics and readiness.

use jiff::Timestamp;

use super::{AttemptOutcome, DeliveryState};
use crate::domain::JobState;

/// Number of attempts with the same outcome and cause.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AttemptCount {
    /// Their outcome.
    pub outcome: AttemptOutcome,
    /// The type of the problem that ended them, without its prefix.
    pub cause: Option<String>,
    /// How many there are.
    pub count: u64,
}

/// Counts over everything that is stored, and counters since the database was created, which never fall.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StoreStats {
    /// Jobs by state, for every state.
    pub jobs: Vec<(JobState, u64)>,
    /// Creation of the oldest queued job.
    pub oldest_queued_at: Option<Timestamp>,
    /// Attempts started, ever.
    pub claims: u64,
    /// Attempts ended, ever.
    pub attempts: Vec<AttemptCount>,
    /// Seconds that succeeded jobs took, ever, by phase.
    pub phase_seconds: Vec<(&'static str, f64)>,
    /// Training steps per second of all running jobs together.
    pub steps_per_second: f64,
    /// Number of blobs in the database.
    pub blobs: u64,
    pub blob_bytes: u64,
    /// Webhook deliveries by state, for every state. Ended ones are kept for a while.
    pub deliveries: Vec<(DeliveryState, u64)>,
}
