//! Retention: jobs that ended long ago are removed, with what only they refer to, and so are records whose time is over.
//!
//! Invariants: a queued or running job is never removed, nor a message that is still to be delivered. A removal is many short transactions,
//! so that no other writer waits for long; one that is interrupted is continued by the next.

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::{Store, StoreError};

/// Removes everything whose time is over, or what there is time for until `stop`; returns how many jobs were removed.
///
/// # Errors
/// The first error; the next removal continues.
pub async fn remove_expired(
    store: &Store,
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
