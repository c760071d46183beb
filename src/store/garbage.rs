//! Clears away what nobody wants any more: uploads whose time is over, files of uploads that have ended, what processes that
//! are gone were staging, blobs that nothing refers to.
//!
//! A blob is published before anything refers to it, so it has a grace time from its latest publication. After that the order is:
//! the table forgets it, in a transaction that finds no reference; then its file goes, unless it was published again meanwhile.
//! Nothing refers to a blob without publishing it except from a row that refers to it already, so none is missed.

use std::{collections::BTreeSet, sync::Arc, time::Duration};

use jiff::{SignedDuration, Timestamp};
use thiserror::Error;
use tokio::time::{Instant, sleep_until};
use tokio_util::sync::CancellationToken;

use super::{BlobError, Blobs, Published, Store, StoreError};
use crate::domain::{Clock, UploadId};

/// Blobs that one transaction looks at, so that it never keeps other writers waiting for long.
const BATCH: usize = 100;

/// How long things are kept, and how often that is looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GarbagePolicy {
    /// Time between two rounds where nothing calls for one earlier.
    pub every: Duration,
    /// Shortest time between two rounds.
    pub at_most_every: Duration,
    /// How long a published blob may wait for a reference.
    pub blob_grace: SignedDuration,
    /// How long an upload that has ended is remembered as one that has.
    pub upload_memory: SignedDuration,
}

impl Default for GarbagePolicy {
    fn default() -> Self {
        Self {
            every: Duration::from_secs(600),
            at_most_every: Duration::from_secs(10),
            blob_grace: SignedDuration::from_hours(1),
            upload_memory: SignedDuration::from_hours(7 * 24),
        }
    }
}

/// What a round cleared away.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Collected {
    /// Uploads that were given up.
    pub uploads: usize,
    /// Blobs.
    pub blobs: usize,
    /// Bytes of those blobs.
    pub bytes: u64,
}

/// Why a round did not come to its end.
#[derive(Debug, Error)]
pub enum GarbageError {
    /// The database failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The file system failed.
    #[error(transparent)]
    Blobs(#[from] BlobError),
}

/// One round, at the time `now`.
///
/// # Errors
/// The first fault; what is left is left to the next round.
pub async fn clear(
    store: &dyn Store,
    blobs: &Blobs,
    policy: &GarbagePolicy,
    now: Timestamp,
) -> Result<Collected, GarbageError> {
    let mut cleared =
        Collected { uploads: clear_uploads(store, blobs, policy, now).await?, ..Collected::default() };
    blobs.clear_staging().await?;
    let before = earlier(now, policy.blob_grace);
    for batch in blobs.older_than(before).await?.chunks(BATCH) {
        for digest in store.forget_blobs(batch).await? {
            if let Some(bytes) = blobs.remove_older(digest, before).await? {
                cleared.blobs += 1;
                cleared.bytes += bytes;
            }
        }
    }
    Ok(cleared)
}

/// Takes back a publication that came to nothing: the blob goes unless something refers to it or somebody publishes it too.
///
/// # Errors
/// The first fault; the blob is then left to a round.
pub async fn withdraw(store: &dyn Store, blobs: &Blobs, published: Published) -> Result<bool, GarbageError> {
    // In the order of a round, and for its reasons.
    if store.forget_blobs(&[published.blob.digest]).await?.is_empty() {
        return Ok(false);
    }
    Ok(blobs.unpublish(published).await?)
}

async fn clear_uploads(
    store: &dyn Store,
    blobs: &Blobs,
    policy: &GarbagePolicy,
    now: Timestamp,
) -> Result<usize, GarbageError> {
    let expired = store.expire_uploads(earlier(now, policy.upload_memory)).await?;
    // The files first: an upload is in the table before it has one.
    let files = blobs.uploads().await?;
    let open: BTreeSet<UploadId> = store.open_uploads().await?.into_iter().collect();
    for upload in files {
        if !open.contains(&upload) {
            // One that is held goes next time.
            blobs.remove_upload(upload).await?;
        }
    }
    Ok(expired.len())
}

fn earlier(now: Timestamp, by: SignedDuration) -> Timestamp {
    now.checked_sub(by).unwrap_or(Timestamp::MIN)
}

/// Clears away until `stop`: now and then, and soon after something was let go ([`Blobs::request_collection`]).
pub async fn collect_garbage(
    store: Arc<dyn Store>,
    blobs: Blobs,
    clock: Arc<dyn Clock>,
    policy: GarbagePolicy,
    stop: CancellationToken,
) {
    loop {
        let began = Instant::now();
        match clear(&*store, &blobs, &policy, clock.now()).await {
            Ok(Collected { uploads: 0, blobs: 0, .. }) => {}
            Ok(Collected { uploads, blobs, bytes }) => {
                tracing::info!(uploads, blobs, bytes, "cleared away {uploads} uploads and {blobs} blobs");
            }
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, "cannot clear away: {error}");
            }
        }
        let pause = async {
            sleep_until(began + policy.at_most_every).await;
            tokio::select! {
                () = sleep_until(began + policy.every) => {}
                () = blobs.collection_requested() => {}
            }
        };
        tokio::select! {
            () = stop.cancelled() => return,
            () = pause => {}
        }
    }
}
