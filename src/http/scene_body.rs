//! A scene as the API shows it.

use jiff::Timestamp;
use serde::Serialize;

use crate::{
    domain::{DatasetSummary, Digest, SceneId},
    store::SceneRecord,
};

/// `#/components/schemas/Scene` of the contract.
#[derive(Debug, Serialize)]
pub(super) struct SceneBody {
    id: SceneId,
    /// What is wrong with a dataset's structure is answered before there is a scene, so there is one state.
    state: &'static str,
    name: Option<String>,
    dataset: DatasetBody,
    summary: DatasetSummary,
    created_at: Timestamp,
    links: Links,
}

#[derive(Debug, Serialize)]
struct DatasetBody {
    bytes: u64,
    sha256: Digest,
}

#[derive(Debug, Serialize)]
struct Links {
    #[serde(rename = "self")]
    this: String,
    jobs: String,
}

/// The path of a scene.
pub(super) fn href(id: SceneId) -> String {
    format!("/v1/scenes/{id}")
}

impl From<SceneRecord> for SceneBody {
    fn from(record: SceneRecord) -> Self {
        Self {
            id: record.id,
            state: "ready",
            name: record.name,
            dataset: DatasetBody { bytes: record.dataset.bytes, sha256: record.dataset.digest },
            summary: record.summary,
            created_at: record.created_at,
            links: Links { this: href(record.id), jobs: format!("/v1/jobs?scene_id={}", record.id) },
        }
    }
}
