//! A scene as the API shows it.

use serde_json::{Value, json};

use crate::{domain::DatasetId, store::DatasetRecord};

/// The path of a scene.
pub(crate) fn href(id: DatasetId) -> String {
    format!("/v1/scenes/{id}")
}

/// `#/components/schemas/Scene` of the contract. A scene exists only once its dataset has been checked, so there is one state.
pub(crate) fn scene(record: &DatasetRecord) -> Value {
    json!({
        "id": record.id,
        "state": "ready",
        "name": record.name,
        "dataset": record.dataset,
        "summary": record.summary,
        "created_at": record.created_at,
        "links": { "self": href(record.id), "jobs": format!("/v1/jobs?scene_id={}", record.id) },
    })
}
