//! The worker processes of a service, as its API sees them.

use super::JobId;

/// The worker processes that a service keeps.
pub trait Workers: Send + Sync {
    /// How many there are.
    fn counts(&self) -> WorkerCounts;

    /// Removes the files of a deleted job outside the store and its blobs; blocks.
    fn forget(&self, job: JobId);
}

/// Numbers of worker processes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorkerCounts {
    /// How many there should be; 0 if others run them.
    pub expected: usize,
    /// How many are alive.
    pub alive: usize,
}
