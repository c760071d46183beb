//! Datasets that jobs can be made of.

use jiff::Timestamp;

use super::{Answer, BlobRef, Intent};
use crate::domain::{DatasetSummary, Digest, KeyId, SceneId, UploadId};

/// A dataset to be kept.
#[derive(Debug, Clone)]
pub struct NewScene {
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
    pub intent: Option<Intent>,
}

/// A kept dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneRecord {
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
pub enum SceneCreation {
    /// It is kept.
    Created(SceneRecord),
    /// Its owner had it already.
    Known(SceneRecord),
}

impl SceneCreation {
    /// The scene, new or old.
    #[must_use]
    pub fn record(&self) -> &SceneRecord {
        match self {
            Self::Created(record) | Self::Known(record) => record,
        }
    }
}

/// What a request to delete a scene came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SceneDeletion {
    /// It is gone.
    Deleted,
    /// So many queued or running jobs are made of it.
    InUse(u64),
    /// It has another version than the one that was to be deleted.
    Changed,
}

/// A place in the list of scenes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ScenePage {
    /// Creation of the last scene seen.
    pub created_at: Timestamp,
    /// Its identity.
    pub id: SceneId,
}

/// The table of scenes. Every method is one transaction.
pub trait Scenes: Send + Sync + 'static {
    /// Keeps a dataset, unless its owner has one with the same archive.
    ///
    /// # Errors
    /// [`super::StoreError::QuotaExceeded`] if the archive is more than its owner has room for,
    /// [`super::StoreError::AlreadyMade`] if the request's key was used before.
    fn create_scene(&self, new: NewScene) -> Answer<'_, SceneCreation>;

    /// The scene as it stands.
    fn scene(&self, id: SceneId) -> Answer<'_, Option<SceneRecord>>;

    /// The scene of `owner` with this archive.
    fn scene_of_dataset(&self, owner: Option<KeyId>, dataset: Digest) -> Answer<'_, Option<SceneRecord>>;

    /// Up to `limit` scenes, newest first, older than `before`; of one owner, or of all.
    fn scenes(
        &self,
        owner: Option<KeyId>,
        before: Option<ScenePage>,
        limit: u32,
    ) -> Answer<'_, Vec<SceneRecord>>;

    /// Deletes the scene unless a queued or running job is made of it, or it has not the wanted version; `None` if there
    /// is no such scene. Finished jobs keep the archive that they were made of.
    fn delete_scene(&self, id: SceneId, version: Option<u64>) -> Answer<'_, Option<SceneDeletion>>;
}
