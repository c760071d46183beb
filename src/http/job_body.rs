//! A job as the API shows it.

use jiff::Timestamp;
use serde::Serialize;

use crate::{
    domain::{Digest, JobId, JobMetrics, JobState, Phase, Problem, Progress, TrainOptions},
    store::JobRecord,
};

/// `#/components/schemas/Job` of the contract.
#[derive(Debug, Serialize)]
pub(super) struct JobBody {
    id: JobId,
    state: JobState,
    phase: Phase,
    progress: Progress,
    metrics: Option<JobMetrics>,
    artifacts: Vec<ArtifactBody>,
    error: Option<Problem>,
    attempt: u32,
    cancel_requested: bool,
    options: TrainOptions,
    dataset: DatasetBody,
    created_at: Timestamp,
    started_at: Option<Timestamp>,
    finished_at: Option<Timestamp>,
    links: Links,
}

#[derive(Debug, Serialize)]
struct ArtifactBody {
    kind: &'static str,
    bytes: u64,
    sha256: Digest,
    href: String,
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
    events: String,
    cancel: String,
    artifact: String,
    view: String,
    views: String,
}

/// The path of a job.
pub(super) fn href(id: JobId) -> String {
    format!("/v1/jobs/{id}")
}

impl From<JobRecord> for JobBody {
    fn from(record: JobRecord) -> Self {
        let file = record.scene();
        let job = record.job;
        let this = href(job.id);
        let artifact = format!("{this}/artifact");
        Self {
            id: job.id,
            state: job.state,
            phase: job.phase,
            progress: job.progress,
            metrics: job.metrics,
            artifacts: file
                .map(|(format, file)| ArtifactBody {
                    kind: format.name(),
                    bytes: file.bytes,
                    sha256: file.digest,
                    href: artifact.clone(),
                })
                .into_iter()
                .collect(),
            error: job.error,
            attempt: job.attempt,
            cancel_requested: job.cancel_requested,
            options: job.options,
            dataset: DatasetBody { bytes: record.dataset.bytes, sha256: record.dataset.digest },
            created_at: job.created_at,
            started_at: job.started_at,
            finished_at: job.finished_at,
            links: Links {
                events: format!("{this}/events"),
                cancel: format!("{this}/cancel"),
                artifact,
                view: format!("{this}/view"),
                views: format!("{this}/views"),
                this,
            },
        }
    }
}
