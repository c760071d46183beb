//! Datasets that jobs can be made of.

use jiff::Timestamp;

use super::{BlobRef, IdempotentRequest, StoreFuture};
use crate::domain::{DatasetSummary, Digest, KeyId, SceneId, UploadId};

/// A dataset to be kept.
#[derive(Debug, Clone)]
pub struct NewDataset {
    /// Its identity, chosen by the caller.
    pub id: SceneId,
    /// Whose it is.
    pub owner: Option<KeyId>,
    /// What its owner calls it.
    pub name: Option<String>,
    /// The archive, already published.
    pub dataset: BlobRef,
    /// What the check of its structure found.
    pub summary: DatasetSummary,
    /// The upload that the archive came by, which ends with this.
    pub upload: Option<UploadId>,
    /// The `Idempotency-Key` of the request that makes it.
    pub intent: Option<IdempotentRequest>,
}

/// A kept dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct DatasetRecord {
    /// Identity.
    pub id: SceneId,
    /// Whose it is; nobody's if it was made while there were no keys.
    pub owner: Option<KeyId>,
    /// What its owner calls it.
    pub name: Option<String>,
    /// The archive.
    pub dataset: BlobRef,
    /// What the check of its structure found.
    pub summary: DatasetSummary,
    /// Row version, raised by every change.
    pub version: u64,
    /// Creation.
    pub created_at: Timestamp,
}

/// What a request to keep a dataset came to.
#[derive(Debug, Clone, PartialEq)]
pub enum DatasetCreation {
    /// It is kept.
    Created(DatasetRecord),
    /// Its owner had it already.
    Existing(DatasetRecord),
}

impl DatasetCreation {
    /// The scene, new or old.
    #[must_use]
    pub fn record(&self) -> &DatasetRecord {
        match self {
            Self::Created(record) | Self::Existing(record) => record,
        }
    }
}

/// What a request to delete a scene came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DatasetDeletion {
    /// It is gone.
    Deleted,
    /// So many queued or running jobs are made of it.
    InUse(u64),
    /// It has another version than the one that was to be deleted.
    VersionMismatch,
}

/// A place in the list of scenes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DatasetPageKey {
    /// Creation of the last scene seen.
    pub created_at: Timestamp,
    /// Its identity.
    pub id: SceneId,
}

/// The table of scenes. Every method is one transaction.
pub trait Datasets: Send + Sync + 'static {
    /// Keeps a dataset, unless its owner has one with the same archive.
    ///
    /// # Errors
    /// [`super::StoreError::QuotaExceeded`] if the archive is more than its owner has room for,
    /// [`super::StoreError::IdempotencyKeyUsed`] if the request's key was used before.
    fn create_dataset(&self, new: NewDataset) -> StoreFuture<'_, DatasetCreation>;

    /// The scene as it stands.
    fn dataset(&self, id: SceneId) -> StoreFuture<'_, Option<DatasetRecord>>;

    /// The scene of `owner` with this archive.
    fn dataset_by_archive(
        &self,
        owner: Option<KeyId>,
        dataset: Digest,
    ) -> StoreFuture<'_, Option<DatasetRecord>>;

    /// Up to `limit` scenes, newest first, older than `before`; of one owner, or of all.
    fn datasets(
        &self,
        owner: Option<KeyId>,
        before: Option<DatasetPageKey>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<DatasetRecord>>;

    /// Deletes the scene unless a queued or running job is made of it, or it has not the wanted version; `None` if there
    /// is no such scene. Finished jobs keep the archive that they were made of.
    fn delete_dataset(&self, id: SceneId, version: Option<u64>) -> StoreFuture<'_, Option<DatasetDeletion>>;
}
