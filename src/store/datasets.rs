//! Datasets that jobs train on; `scenes` in the API and in the database.

use jiff::Timestamp;

use super::{BlobRef, IdempotentRequest};
use crate::domain::{DatasetId, DatasetSummary, ProjectId, UploadId};

/// A dataset to be added.
#[derive(Debug, Clone)]
pub struct NewDataset {
    /// Its identity, chosen by the caller.
    pub id: DatasetId,
    pub project: ProjectId,
    /// Its name, chosen by its user.
    pub name: Option<String>,
    /// The archive, already published.
    pub dataset: BlobRef,
    /// Summary of the structure check.
    pub summary: DatasetSummary,
    /// The upload of the archive, which ends with this.
    pub upload: Option<UploadId>,
    /// The `Idempotency-Key` of the request that creates it.
    pub intent: Option<IdempotentRequest>,
}

/// A stored dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct DatasetRecord {
    pub id: DatasetId,
    pub project: ProjectId,
    /// Its name, chosen by its user.
    pub name: Option<String>,
    /// The archive.
    pub dataset: BlobRef,
    /// Summary of the structure check.
    pub summary: DatasetSummary,
    /// Whether it stays without jobs. One that came as the body of a job is deleted with the last of its jobs until a request keeps it.
    pub kept: bool,
    /// Row version, incremented by every change.
    pub version: u64,
    pub created_at: Timestamp,
}

/// Result of a request to add a dataset.
#[derive(Debug, Clone, PartialEq)]
pub enum DatasetCreation {
    /// It was added.
    Created(DatasetRecord),
    /// Its project has it already.
    Existing(DatasetRecord),
}

impl DatasetCreation {
    /// The dataset, new or existing.
    #[must_use]
    pub fn record(&self) -> &DatasetRecord {
        match self {
            Self::Created(record) | Self::Existing(record) => record,
        }
    }
}

/// Result of a request to delete a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DatasetDeletion {
    Deleted,
    /// This many queued or running jobs train on it.
    InUse(u64),
    /// It has another version than the requested one.
    VersionMismatch,
}

/// A position in the list of datasets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DatasetPageKey {
    /// Creation of the last dataset seen.
    pub created_at: Timestamp,
    /// Its identity.
    pub id: DatasetId,
}
