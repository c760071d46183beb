//! Checks a data folder: the database, and the files that it refers to. Changes nothing.
//!
//! A service may run meanwhile. A file that is missing counts only if the database still refers to it afterwards, and a file that nothing
//! refers to only if it is older than the time that garbage collection leaves to publishers.

use jiff::Timestamp;
use serde::Serialize;

use super::{
    BlobRef, BlobState, Blobs, CheckDepth, Store,
    garbage::{GarbageError, GarbagePolicy},
};
use crate::domain::Digest;

/// Blobs looked up at a time.
pub(super) const BATCH: u32 = 500;

/// What was found in a data folder.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct FsckReport {
    /// Files that the database refers to.
    pub blobs: u64,
    pub bytes: u64,
    /// Whether their content was read, not only their lengths.
    pub content_checked: bool,
    /// Those that are not there.
    pub missing: Vec<Digest>,
    /// Those with other content or another length.
    pub damaged: Vec<Digest>,
    /// Files that nothing refers to; the service removes them.
    pub orphans: Vec<Digest>,
    /// What SQLite says of the database, if it is not sound.
    pub database: Vec<String>,
}

impl FsckReport {
    /// Whether nothing is missing or damaged. Files that nothing refers to do no harm.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.missing.is_empty() && self.damaged.is_empty() && self.database.is_empty()
    }
}

/// Checks a data folder at the time `now`.
///
/// # Errors
/// [`GarbageError`] if the database or a file cannot be read at all.
pub async fn check(
    store: &Store,
    blobs: &Blobs,
    depth: CheckDepth,
    now: Timestamp,
) -> Result<FsckReport, GarbageError> {
    let mut report = FsckReport {
        content_checked: depth == CheckDepth::Content,
        database: store.integrity().await?,
        ..FsckReport::default()
    };
    let mut after = None;
    loop {
        let batch = store.blob_rows(after, BATCH).await?;
        let Some(last) = batch.last() else { break };
        after = Some(last.digest);
        for blob in batch {
            check_one(store, blobs, blob, depth, &mut report).await?;
        }
    }
    let grace = GarbagePolicy::default().blob_grace;
    for batch in blobs.older_than(grace, now).await?.all()?.chunks(BATCH as usize) {
        report.orphans.extend(store.without_references(batch).await?);
    }
    Ok(report)
}

async fn check_one(
    store: &Store,
    blobs: &Blobs,
    blob: BlobRef,
    depth: CheckDepth,
    report: &mut FsckReport,
) -> Result<(), GarbageError> {
    let state = blobs.check(blob, depth).await?;
    // Looked up afterwards: its last reference may just have been deleted.
    if !store.without_references(&[blob.digest]).await?.is_empty() {
        return Ok(());
    }
    report.blobs += 1;
    report.bytes += blob.bytes;
    match state {
        BlobState::Sound => {}
        BlobState::Missing => report.missing.push(blob.digest),
        BlobState::Damaged => report.damaged.push(blob.digest),
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_fault_of_any_kind_is_enough_and_orphans_are_none() {
        let blob = Digest::of(b"blob");
        let sound = FsckReport { blobs: 1, orphans: vec![blob], ..FsckReport::default() };
        assert!(sound.is_sound());
        for error in [
            FsckReport { missing: vec![blob], ..sound.clone() },
            FsckReport { damaged: vec![blob], ..sound.clone() },
            FsckReport { database: vec!["a page is torn".to_owned()], ..sound.clone() },
        ] {
            assert!(!error.is_sound(), "{error:?}");
        }
    }
}
