//! Archives that come in parts: how much of each is on disk, and the room that is kept for the rest.

use jiff::Timestamp;

use super::StoreFuture;
use crate::domain::{KeyId, SceneId, UploadId};

/// An upload to be begun.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewUpload {
    /// Its identity, chosen by the caller.
    pub id: UploadId,
    /// Whose it is.
    pub owner: Option<KeyId>,
    /// Bytes that it will have.
    pub length: u64,
    /// What its sender says of it, as it was sent.
    pub metadata: Option<String>,
    /// When it is given up.
    pub expires_at: Timestamp,
}

/// An upload as it stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UploadRecord {
    /// Identity.
    pub id: UploadId,
    /// Whose it is; nobody's if it was made while there were no keys.
    pub owner: Option<KeyId>,
    /// Bytes that it will have.
    pub length: u64,
    /// Bytes that are surely on disk.
    pub received: u64,
    /// What its sender says of it, as it was sent.
    pub metadata: Option<String>,
    /// The scene that was made of it, unless that was deleted since.
    pub scene: Option<SceneId>,
    /// Creation.
    pub created_at: Timestamp,
    /// When it is given up.
    pub expires_at: Timestamp,
    /// When it was used or given up.
    pub ended_at: Option<Timestamp>,
}

impl UploadRecord {
    /// Whether it still takes bytes, or can be made a scene of.
    #[must_use]
    pub fn is_open(&self, now: Timestamp) -> bool {
        self.ended_at.is_none() && now < self.expires_at
    }

    /// Whether every byte has come.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.received == self.length
    }
}

/// The table of uploads. Every method is one transaction.
///
/// Who writes to an upload holds its file's lock, so the count of received bytes has one writer.
pub trait Uploads: Send + Sync + 'static {
    /// Begins an upload and keeps its room.
    ///
    /// # Errors
    /// [`super::StoreError::QuotaExceeded`] if that is more than its owner has room for.
    fn create_upload(&self, new: NewUpload) -> StoreFuture<'_, UploadRecord>;

    /// The upload as it stands.
    fn upload(&self, id: UploadId) -> StoreFuture<'_, Option<UploadRecord>>;

    /// Records that `received` bytes are on disk and puts off the end; false if the upload has ended.
    fn advance_upload(&self, id: UploadId, received: u64, expires_at: Timestamp) -> StoreFuture<'_, bool>;

    /// Forgets an upload and gives its room back; false if there is none that is open.
    fn delete_upload(&self, id: UploadId) -> StoreFuture<'_, bool>;

    /// Bytes of open uploads that have not come yet.
    fn outstanding_bytes(&self) -> StoreFuture<'_, u64>;

    /// Ends the uploads whose time is over and returns them. Their rows stay, to say so, until they have been ended since
    /// before `forget`.
    fn expire_uploads(&self, forget: Timestamp) -> StoreFuture<'_, Vec<UploadId>>;

    /// Every upload that is open: whose file must stay.
    fn open_uploads(&self) -> StoreFuture<'_, Vec<UploadId>>;
}
