//! A dataset as the API shows it.

use serde_json::{Value, json};

use super::naming::Naming;
use crate::store::DatasetRecord;

/// `#/components/schemas/Scene` of the contract. It exists only once the archive has been checked, so there is one state.
pub(crate) fn dataset(record: &DatasetRecord, naming: Naming) -> Value {
    json!({
        "id": record.id,
        "state": "ready",
        "name": record.name,
        "dataset": record.dataset,
        "summary": record.summary,
        "kept": record.kept,
        "created_at": record.created_at,
        "links": { "self": naming.href(record.id), "jobs": naming.jobs(record.id) },
    })
}
