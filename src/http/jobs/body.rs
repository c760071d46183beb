//! A job as the API shows it.

use serde_json::{Value, json};

use crate::{
    domain::JobId,
    store::{BlobRef, JobRecord, SceneArtifact},
};

/// Names of a job's fields.
pub(super) const FIELDS: [&str; 26] = [
    "id",
    "project_id",
    "created_by",
    "name",
    "metadata",
    "state",
    "queue_position",
    "phase",
    "progress",
    "metrics",
    "artifacts",
    "error",
    "attempt",
    "attempts",
    "cancel_requested",
    "priority",
    "deadline_at",
    "retry_of",
    "dataset_id",
    "scene_id",
    "options",
    "dataset",
    "created_at",
    "started_at",
    "finished_at",
    "links",
];

/// The path of a job.
pub(crate) fn href(id: JobId) -> String {
    format!("/v1/jobs/{id}")
}

/// `#/components/schemas/Job` of the contract.
pub(crate) fn job(record: &JobRecord) -> Value {
    let job = &record.job;
    let this = href(job.id);
    let artifact = |SceneArtifact { format, lambda, blob: BlobRef { bytes, digest } }| {
        let query = lambda.map(|lambda| format!("?lambda={lambda}")).unwrap_or_default();
        let href = format!("{this}/artifact{query}");
        json!({ "kind": format, "lambda": lambda, "bytes": bytes, "sha256": digest, "href": href })
    };
    let links = json!({
        "self": this,
        "events": format!("{this}/events"),
        "series": format!("{this}/series"),
        "cancel": format!("{this}/cancel"),
        "retry": format!("{this}/retry"),
        "artifact": format!("{this}/artifact"),
        "artifacts": format!("{this}/artifacts"),
        "thumbnail": format!("{this}/thumbnail"),
        "preview": format!("{this}/preview"),
        "export": format!("{this}/export"),
        "cameras": format!("{this}/cameras"),
        "view": format!("{this}/view"),
        "views": format!("{this}/views"),
        "stream": format!("{this}/stream"),
        "animation": format!("{this}/animation"),
        "report": format!("{this}/report"),
        "viewer": format!("{this}/viewer"),
    });
    json!({
        "id": job.id,
        "project_id": record.project,
        "created_by": record.key,
        "name": record.name,
        "metadata": record.metadata,
        "state": job.state,
        "queue_position": record.queue_position,
        "phase": job.phase,
        "progress": job.progress,
        "metrics": job.metrics,
        "artifacts": record.scenes().map(artifact).collect::<Value>(),
        "error": job.error,
        "attempt": job.attempt,
        "attempts": record.attempts,
        "cancel_requested": job.cancel_requested,
        "priority": record.priority,
        "deadline_at": record.deadline_at,
        "retry_of": record.retry_of,
        "dataset_id": record.dataset_id,
        "scene_id": record.dataset_id,
        "options": job.options,
        "dataset": record.dataset,
        "created_at": job.created_at,
        "started_at": job.started_at,
        "finished_at": job.finished_at,
        "links": links,
    })
}
