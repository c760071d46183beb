//! Resumable uploads: how much of each is on disk, and the bytes reserved for the rest.

use jiff::{SignedDuration, Timestamp};

use crate::domain::{DatasetId, ProjectId, UploadId};

/// Open uploads that a project may have at a time.
pub const MAX_OPEN_UPLOADS: u32 = 256;

/// An upload to be started.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewUpload {
    /// Its identity, chosen by the caller.
    pub id: UploadId,
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
    pub id: UploadId,
    pub project: ProjectId,
    /// Total bytes.
    pub length: u64,
    /// Bytes flushed to disk.
    pub received: u64,
    /// The client's metadata, as it was sent.
    pub metadata: Option<String>,
    /// The dataset that was created from it, unless that was deleted since.
    pub dataset_id: Option<DatasetId>,
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

/// How long a writer keeps an upload's lock without renewing it.
pub const WRITER_LIFE: SignedDuration = SignedDuration::from_secs(60);

/// One writer of an upload; a later one has a higher number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UploadWriter {
    pub id: UploadId,
    pub number: i64,
}
