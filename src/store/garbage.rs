//! Garbage collection: jobs past their retention, expired uploads, files of ended uploads, staging folders of dead processes, unreferenced
//! blobs.
//!
//! A blob is published before anything refers to it, so it has a grace time from its latest publication. After that, a transaction that
//! finds no reference deletes its row; then its file is removed, unless it was published again meanwhile. A new reference is added only
//! after a publication or from a row that already has one, so no referenced blob is removed.

use std::{collections::BTreeSet, error::Error, fmt, sync::Arc, time::Duration};

use jiff::{SignedDuration, Timestamp};
use thiserror::Error;
use tokio::time::{Instant, sleep, sleep_until};
use tokio_util::sync::CancellationToken;

use super::{BlobError, Blobs, OldBlobs, Published, Store, StoreError, earlier, retention::remove_expired};
use crate::domain::{Clock, UploadId, with_defaults};

/// Blobs per transaction, so that other writers never wait for long.
const BATCH: usize = 100;

/// Removals in a row that fail before a collection ends.
const MAX_FAILURES: u32 = 10;

/// How long a removal may go on once the service stops; a later collection completes what is left.
const STOP_TIME: Duration = Duration::from_secs(5);

with_defaults! {
    /// When garbage is collected, and how old it must be.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct GarbagePolicy {
        /// Time between two collections, unless one is requested earlier.
        pub every: Duration = Duration::from_secs(600),
        /// Shortest time between two collections. It is as long as the one before took if that is longer, so that requests for a collection do
        /// not keep the disk or the bucket busy all the time.
        pub at_most_every: Duration = Duration::from_secs(10),
        /// How long a published blob may stay unreferenced.
        pub blob_grace: SignedDuration = SignedDuration::from_hours(1),
        /// How long the row of an ended upload is kept.
        pub upload_ttl: SignedDuration = SignedDuration::from_hours(7 * 24),
        /// How long an ended job is kept; for ever if `None`.
        pub keep_jobs: Option<Duration> = None,
    }
}

impl GarbagePolicy {
    /// Shortest time between a collection that took as long as `took` and the next one.
    fn rest(&self, took: Duration) -> Duration {
        self.at_most_every.max(took)
    }
}

/// What a collection removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Collected {
    /// Expired uploads.
    pub uploads: usize,
    pub blobs: usize,
    /// Bytes of those blobs.
    pub bytes: u64,
}

/// Why a collection stopped early.
#[derive(Debug, Error)]
pub enum GarbageError {
    /// The database failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The file system failed.
    #[error(transparent)]
    Blobs(#[from] BlobError),
}

/// Collects once, at the time `now`.
///
/// # Errors
/// The first error, after everything else was removed; the next collection removes the rest.
pub async fn collect(
    store: &Store,
    blobs: &Blobs,
    policy: &GarbagePolicy,
    now: Timestamp,
) -> Result<Collected, GarbageError> {
    collect_until(store, blobs, policy, now, &CancellationToken::new()).await
}

/// As [`collect`], but leaves the rest once `stop` is cancelled.
async fn collect_until(
    store: &Store,
    blobs: &Blobs,
    policy: &GarbagePolicy,
    now: Timestamp,
    stop: &CancellationToken,
) -> Result<Collected, GarbageError> {
    // A database that has lost its bucket to another must not remove the other's objects.
    blobs.check_owner().await?;
    let mut failures = Failures::default();
    let uploads = collect_uploads(store, blobs, policy, now, &mut failures).await?;
    let mut collected = Collected { uploads, ..Collected::default() };
    failures.note("staging folders", blobs.clear_staging().await)?;
    failures.note("blobs that another process began to remove", blobs.finish_removals().await)?;
    let age = policy.blob_grace;
    let OldBlobs { digests, error } = blobs.older_than(age, now).await?;
    failures.note("something among the blobs", error.map_or(Ok(()), Err))?;
    for batch in digests.chunks(BATCH) {
        if stop.is_cancelled() {
            break;
        }
        for digest in store.forget_blobs(batch).await? {
            if stop.is_cancelled() {
                break;
            }
            let removed = blobs.remove_older(digest, age, now).await;
            if let Some(Some(bytes)) = failures.note(format!("blob {digest}"), removed)? {
                collected.blobs += 1;
                collected.bytes += bytes;
            }
        }
    }
    failures.into_result()?;
    Ok(collected)
}

/// What could not be removed. One such thing leaves the others to be removed.
#[derive(Default)]
struct Failures {
    first: Option<BlobError>,
    in_a_row: u32,
}

impl Failures {
    /// Logs an error, or returns the value.
    ///
    /// # Errors
    /// This error, if it is one of many in a row: then nothing can be removed.
    fn note<T>(
        &mut self,
        what: impl fmt::Display,
        removed: Result<T, BlobError>,
    ) -> Result<Option<T>, BlobError> {
        let error = match removed {
            Ok(value) => {
                self.in_a_row = 0;
                return Ok(Some(value));
            }
            Err(error) => error,
        };
        self.in_a_row += 1;
        if self.in_a_row >= MAX_FAILURES {
            return Err(error);
        }
        tracing::warn!(error = &error as &dyn Error, "{what} cannot be removed: {error}");
        self.first.get_or_insert(error);
        Ok(None)
    }

    fn into_result(self) -> Result<(), BlobError> {
        self.first.map_or(Ok(()), Err)
    }
}

/// Withdraws a publication that was not used: removes the blob unless something refers to it or it was published again.
///
/// # Errors
/// The first error; a later collection then removes the blob.
pub async fn withdraw(store: &Store, blobs: &Blobs, published: Published) -> Result<bool, GarbageError> {
    // In the same order as a collection, for the same reasons.
    if store.forget_blobs(&[published.blob.digest]).await?.is_empty() {
        return Ok(false);
    }
    Ok(blobs.unpublish(published).await?)
}

async fn collect_uploads(
    store: &Store,
    blobs: &Blobs,
    policy: &GarbagePolicy,
    now: Timestamp,
    failures: &mut Failures,
) -> Result<usize, GarbageError> {
    let expired = store.expire_uploads(earlier(now, policy.upload_ttl)).await?;
    // The files first: an upload is in the table before it has one.
    let files = blobs.uploads().await?;
    let open: BTreeSet<UploadId> = store.open_uploads().await?.into_iter().collect();
    for upload in files {
        if !open.contains(&upload) {
            // A file that is locked is removed next time.
            let removed = blobs.remove_upload(upload).await;
            failures.note(format!("upload {upload}"), removed)?;
        }
    }
    Ok(expired.len())
}

/// Collects until `stop`, at intervals and soon after [`Blobs::request_collection`].
pub async fn collect_garbage(
    store: Store,
    blobs: Blobs,
    clock: Arc<dyn Clock>,
    policy: GarbagePolicy,
    stop: CancellationToken,
) {
    loop {
        let started = Instant::now();
        // First, so that the blobs of removed jobs are collected at once.
        match remove_expired(&store, policy.keep_jobs, &stop).await {
            Ok(0) => {}
            Ok(jobs) => tracing::info!(jobs, "removed {jobs} jobs that ended too long ago to be kept"),
            Err(error) => {
                tracing::warn!(error = &error as &dyn Error, "ended jobs cannot be removed: {error}");
            }
        }
        let collecting = collect_until(&store, &blobs, &policy, clock.now(), &stop);
        let collected = tokio::select! {
            collected = collecting => collected,
            () = overdue(&stop) => {
                tracing::warn!("garbage collection has not stopped in time; a later one removes the rest");
                return;
            }
        };
        match collected {
            Ok(Collected { uploads: 0, blobs: 0, .. }) => {}
            Ok(Collected { uploads, blobs, bytes }) => {
                tracing::info!(
                    uploads,
                    blobs,
                    bytes,
                    "removed {uploads} expired uploads and {blobs} unreferenced blobs"
                );
            }
            Err(error) => {
                tracing::warn!(error = &error as &dyn Error, "garbage collection failed: {error}");
            }
        }
        let ended = Instant::now();
        let pause = async {
            sleep_until(ended + policy.rest(ended - started)).await;
            tokio::select! {
                () = sleep_until(started + policy.every) => {}
                () = blobs.collection_requested() => {}
            }
        };
        tokio::select! {
            () = stop.cancelled() => return,
            () = pause => {}
        }
    }
}

/// Ends [`STOP_TIME`] after `stop` is cancelled.
async fn overdue(stop: &CancellationToken) {
    stop.cancelled().await;
    sleep(STOP_TIME).await;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn collections_take_half_of_the_time_at_most() {
        let policy = GarbagePolicy::default();
        for (took, rest) in [(0, 10), (10, 10), (3600, 3600)] {
            assert_eq!(policy.rest(Duration::from_secs(took)), Duration::from_secs(rest));
        }
    }
}
