//! A scene as the API shows it.

use jiff::Timestamp;
use serde::Serialize;

use crate::{
    domain::{DatasetId, DatasetSummary, Digest},
    store::{BlobRef, DatasetRecord},
};

/// `#/components/schemas/Scene` of the contract.
#[derive(Debug, Serialize)]
pub(crate) struct SceneBody {
    id: DatasetId,
    /// A scene exists only once its dataset has been checked, so there is one state.
    state: &'static str,
    name: Option<String>,
    dataset: DatasetBody,
    summary: DatasetSummary,
    created_at: Timestamp,
    links: Links,
}

/// The archive that a scene or a job is made of.
#[derive(Debug, Serialize)]
pub(crate) struct DatasetBody {
    bytes: u64,
    sha256: Digest,
}

impl From<BlobRef> for DatasetBody {
    fn from(BlobRef { digest, bytes }: BlobRef) -> Self {
        Self { bytes, sha256: digest }
    }
}

#[derive(Debug, Serialize)]
struct Links {
    #[serde(rename = "self")]
    this: String,
    jobs: String,
}

/// The path of a scene.
pub(crate) fn href(id: DatasetId) -> String {
    format!("/v1/scenes/{id}")
}

impl From<DatasetRecord> for SceneBody {
    fn from(record: DatasetRecord) -> Self {
        Self {
            id: record.id,
            state: "ready",
            name: record.name,
            dataset: record.dataset.into(),
            summary: record.summary,
            created_at: record.created_at,
            links: Links { this: href(record.id), jobs: format!("/v1/jobs?scene_id={}", record.id) },
        }
    }
}
