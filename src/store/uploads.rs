//! Resumable uploads: how much of each is on disk, and the bytes reserved for the rest.

use jiff::{SignedDuration, Timestamp};

use super::StoreFuture;
use crate::domain::{DatasetId, ProjectId, UploadId};

/// Open uploads that a project may have at a time.
pub const MAX_OPEN_UPLOADS: u32 = 256;

/// An upload to be started.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewUpload {
    /// Its identity, chosen by the caller.
    pub id: UploadId,
    /// Its project.
    pub project: ProjectId,
    /// Total bytes.
    pub length: u64,
    /// The client's metadata, as it was sent.
    pub metadata: Option<String>,
    /// When it expires.
    pub expires_at: Timestamp,
}

/// An upload.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UploadRecord {
    /// Identity.
    pub id: UploadId,
    /// Its project.
    pub project: ProjectId,
    /// Total bytes.
    pub length: u64,
    /// Bytes flushed to disk.
    pub received: u64,
    /// The client's metadata, as it was sent.
    pub metadata: Option<String>,
    /// The dataset that was created from it, unless that was deleted since.
    pub dataset_id: Option<DatasetId>,
    /// Creation.
    pub created_at: Timestamp,
    /// When it expires.
    pub expires_at: Timestamp,
    /// When it was used or expired.
    pub ended_at: Option<Timestamp>,
}

impl UploadRecord {
    /// Whether it accepts bytes, or can become a dataset.
    #[must_use]
    pub fn is_open(&self, now: Timestamp) -> bool {
        self.ended_at.is_none() && now < self.expires_at
    }

    /// Whether every byte was received.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.received == self.length
    }
}

/// The table of uploads. Every method is one transaction.
///
/// A writer holds the lock of the upload's file, so the count of received bytes has one writer.
pub trait Uploads: Send + Sync + 'static {
    /// Starts an upload and reserves its bytes.
    ///
    /// # Errors
    /// [`super::StoreError::QuotaExceeded`], [`super::StoreError::TooManyUploads`].
    fn create_upload(&self, new: NewUpload) -> StoreFuture<'_, UploadRecord>;

    /// The upload.
    fn upload(&self, id: UploadId) -> StoreFuture<'_, Option<UploadRecord>>;

    /// Records that `received` bytes are on disk, and extends the expiry; false if the upload has ended.
    fn advance_upload(&self, id: UploadId, received: u64, expires_at: Timestamp) -> StoreFuture<'_, bool>;

    /// Deletes an open upload and releases its bytes; false if there is none.
    fn delete_upload(&self, id: UploadId) -> StoreFuture<'_, bool>;

    /// Bytes of open uploads that are still to be received.
    fn outstanding_bytes(&self) -> StoreFuture<'_, u64>;

    /// Ends the expired uploads and returns them. Deletes the rows of uploads that ended before `forget`.
    fn expire_uploads(&self, forget: Timestamp) -> StoreFuture<'_, Vec<UploadId>>;

    /// Every open upload: their files must stay.
    fn open_uploads(&self) -> StoreFuture<'_, Vec<UploadId>>;
}

/// How long a writer keeps an upload's lock without renewing it.
pub const WRITER_LIFE: SignedDuration = SignedDuration::from_secs(60);

/// One writer of an upload; a later one has a higher number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UploadWriter {
    /// The upload.
    pub id: UploadId,
    /// The number.
    pub number: i64,
}

/// Uploads in a bucket: who writes, and what is there. Every method is one transaction.
pub trait UploadParts: Send + Sync + 'static {
    /// Locks an upload for a new writer; `None` if another has locked it, or there is none.
    fn lock_upload(&self, id: UploadId) -> StoreFuture<'_, Option<UploadWriter>>;

    /// Renews a writer's lock; false if it has lost it.
    fn renew_upload_lock(&self, writer: UploadWriter) -> StoreFuture<'_, bool>;

    /// Releases a writer's lock, if it has it.
    fn unlock_upload(&self, writer: UploadWriter) -> StoreFuture<'_, ()>;

    /// Records a part from byte `start` to byte `received`, and extends the expiry; false if the upload has ended or the writer has lost
    /// the lock.
    fn add_upload_part<'a>(
        &'a self,
        writer: UploadWriter,
        start: u64,
        name: &'a str,
        received: u64,
        expires_at: Timestamp,
    ) -> StoreFuture<'a, bool>;

    /// Whether there is such an upload, open or ended.
    fn is_upload(&self, id: UploadId) -> StoreFuture<'_, bool>;

    /// The starts and names of an upload's parts, in order.
    fn upload_parts(&self, id: UploadId) -> StoreFuture<'_, Vec<(u64, String)>>;
}
