//! A job as the API shows it.

use jiff::Timestamp;
use serde::Serialize;
use serde_json::{Value, json};

use crate::{
    domain::{
        DatasetId, JobId, JobMetrics, JobState, KeyId, Metadata, Phase, Problem, Progress, ProjectId,
        TrainOptions,
    },
    store::{AttemptRecord, BlobRef, JobRecord, SceneArtifact},
};

/// `#/components/schemas/Job` of the contract.
#[derive(Debug, Serialize)]
pub(crate) struct JobBody {
    id: JobId,
    project_id: ProjectId,
    created_by: Option<KeyId>,
    name: Option<String>,
    metadata: Metadata,
    state: JobState,
    queue_position: Option<u32>,
    phase: Phase,
    progress: Progress,
    metrics: Option<JobMetrics>,
    artifacts: Vec<Value>,
    error: Option<Problem>,
    attempt: u32,
    attempts: Vec<AttemptRecord>,
    cancel_requested: bool,
    priority: i32,
    deadline_at: Option<Timestamp>,
    retry_of: Option<JobId>,
    scene_id: Option<DatasetId>,
    options: TrainOptions,
    dataset: BlobRef,
    created_at: Timestamp,
    started_at: Option<Timestamp>,
    finished_at: Option<Timestamp>,
    links: Value,
}

/// The path of a job.
pub(crate) fn href(id: JobId) -> String {
    format!("/v1/jobs/{id}")
}

impl From<JobRecord> for JobBody {
    fn from(record: JobRecord) -> Self {
        let this = href(record.job.id);
        let artifacts = record
            .scenes()
            .map(|SceneArtifact { format, lambda, blob: BlobRef { bytes, digest } }| {
                let query = lambda.map(|lambda| format!("?lambda={lambda}")).unwrap_or_default();
                let href = format!("{this}/artifact{query}");
                json!({ "kind": format, "lambda": lambda, "bytes": bytes, "sha256": digest, "href": href })
            })
            .collect();
        let job = record.job;
        Self {
            id: job.id,
            project_id: record.project,
            created_by: record.key,
            name: record.name,
            metadata: record.metadata,
            state: job.state,
            queue_position: record.queue_position,
            phase: job.phase,
            progress: job.progress,
            metrics: job.metrics,
            artifacts,
            error: job.error,
            attempt: job.attempt,
            attempts: record.attempts,
            cancel_requested: job.cancel_requested,
            priority: record.priority,
            deadline_at: record.deadline_at,
            retry_of: record.retry_of,
            scene_id: record.dataset_id,
            options: job.options,
            dataset: record.dataset,
            created_at: job.created_at,
            started_at: job.started_at,
            finished_at: job.finished_at,
            links: json!({
                "self": this,
                "events": format!("{this}/events"),
                "series": format!("{this}/series"),
                "cancel": format!("{this}/cancel"),
                "retry": format!("{this}/retry"),
                "artifact": format!("{this}/artifact"),
                "artifacts": format!("{this}/artifacts"),
                "export": format!("{this}/export"),
                "view": format!("{this}/view"),
                "views": format!("{this}/views"),
                "stream": format!("{this}/stream"),
                "animation": format!("{this}/animation"),
                "report": format!("{this}/report"),
            }),
        }
    }
}
