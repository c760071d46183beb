//! Retention: jobs that ended long ago are removed, with what only they refer to, and so are records whose time is over.
//!
//! Invariants: a queued or running job is never removed, nor a message that is still to be delivered. A removal is many short transactions,
//! so that no other writer waits for long; one that is interrupted is continued by the next.

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::{PageKey, Store, StoreError, StoreFuture};

/// The part of a store that removes what is kept for a time only. Every method is a few transactions of bounded length.
pub trait Retention: Send + Sync + 'static {
    /// Removes some of the jobs that ended longer ago than `keep`, oldest first, of those created after `after`: each with its events,
    /// attempts, series, artifacts and exports.
    fn remove_ended_jobs(&self, keep: Duration, after: Option<PageKey>) -> StoreFuture<'_, RemovedJobs>;

    /// Removes some of the rows of `Idempotency-Key`s and of messages that are over, and counts them: those past their own time, and
    /// with `keep`, messages older than that whose job is gone.
    fn remove_expired_records(&self, keep: Option<Duration>) -> StoreFuture<'_, u64>;
}

/// Result of one step of [`Retention::remove_ended_jobs`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RemovedJobs {
    /// How many jobs were removed.
    pub count: u64,
    /// Where the next step continues; `None` once there are no more.
    pub next: Option<PageKey>,
}

/// Removes everything whose time is over, or what there is time for until `stop`; returns how many jobs were removed.
///
/// # Errors
/// The first error; the next removal continues.
pub async fn remove_expired(
    store: &dyn Store,
    keep_jobs: Option<Duration>,
    stop: &CancellationToken,
) -> Result<u64, StoreError> {
    let mut jobs = 0;
    if let Some(keep) = keep_jobs {
        let mut after = None;
        while !stop.is_cancelled() {
            let removed = store.remove_ended_jobs(keep, after).await?;
            jobs += removed.count;
            after = removed.next;
            if after.is_none() {
                break;
            }
        }
    }
    while !stop.is_cancelled() && store.remove_expired_records(keep_jobs).await? > 0 {}
    Ok(jobs)
}
