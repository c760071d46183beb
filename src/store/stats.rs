//! What the database says of the service as a whole, for metrics and readiness.

use jiff::Timestamp;

use super::{AttemptOutcome, DeliveryState, StoreFuture};
use crate::domain::JobState;

/// Attempts that ended alike.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AttemptCount {
    /// How they ended.
    pub outcome: AttemptOutcome,
    /// The type of the problem that ended them, without its prefix.
    pub cause: Option<String>,
    /// How many there are.
    pub count: u64,
}

/// Counts over everything that is stored, and counters since the database was created, which never fall.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StoreStats {
    /// Jobs in each state, every one of them named.
    pub jobs: Vec<(JobState, u64)>,
    /// Creation of the oldest job that is queued.
    pub oldest_queued_at: Option<Timestamp>,
    /// Attempts begun since the beginning.
    pub claims: u64,
    /// Attempts ended since the beginning.
    pub attempts: Vec<AttemptCount>,
    /// Seconds that succeeded jobs took since the beginning, by phase.
    pub phase_seconds: Vec<(&'static str, f64)>,
    /// Steps a second of the jobs that run, together.
    pub steps_per_second: f64,
    /// Blobs that the database knows.
    pub blobs: u64,
    /// Their bytes.
    pub blob_bytes: u64,
    /// Messages to webhooks in each state, every one of them named. Ended ones are kept for a while.
    pub deliveries: Vec<(DeliveryState, u64)>,
}

/// The part of a store that looks at all of it.
pub trait Overview: Send + Sync + 'static {
    /// The figures as they stand.
    fn stats(&self) -> StoreFuture<'_, StoreStats>;

    /// Whether the schema is the one that this program was built with; another program may have brought it further since.
    fn schema_is_current(&self) -> StoreFuture<'_, bool>;

    /// Commits a small change, to show that the database can be written.
    fn probe(&self) -> StoreFuture<'_, ()>;
}
