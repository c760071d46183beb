//! A job as the commands read it, and how one is named.

use serde::Deserialize;
use serde_json::Value;
use tcgs::domain::{JobId, JobMetrics, JobState, Phase, Problem, Progress};

use super::Connection;
use crate::cli::{Failure, Report, train};

/// What the commands need of a job.
#[derive(Debug, Deserialize)]
pub(super) struct JobView {
    pub(super) id: JobId,
    pub(super) state: JobState,
    pub(super) phase: Phase,
    pub(super) progress: Progress,
    pub(super) metrics: Option<JobMetrics>,
    pub(super) error: Option<Problem>,
    pub(super) artifacts: Vec<ArtifactView>,
}

/// A file of a job.
#[derive(Debug, Deserialize)]
pub(super) struct ArtifactView {
    pub(super) kind: String,
    pub(super) lambda: Option<f64>,
    pub(super) bytes: u64,
    pub(super) sha256: tcgs::domain::Digest,
    pub(super) href: String,
}

/// A job that a person names: by its id, or by a path or address that ends with it.
pub(super) fn parse(text: &str) -> Result<JobId, String> {
    let name = text.trim_end_matches('/').rsplit('/').next().unwrap_or_default();
    name.parse().map_err(|_| format!("'{text}' is no job id"))
}

/// The path of a job.
pub(super) fn path(job: JobId) -> String {
    format!("/v1/jobs/{job}")
}

/// The job as the service has it, whole and as far as the commands read it.
pub(super) async fn get(connection: &Connection, job: JobId) -> Result<(Value, JobView), Failure> {
    read(connection.get(&path(job)).await?)
}

/// As [`get`], of what an answer holds.
pub(super) fn read(whole: Value) -> Result<(Value, JobView), Failure> {
    let view = JobView::deserialize(&whole)
        .map_err(|fault| super::connection::unexpected(format!("its job cannot be read: {fault}")))?;
    Ok((whole, view))
}

/// What a command says of a finished job: its figures, or its failure as the command's own.
pub(super) fn conclude(whole: Value, job: JobView) -> Result<Report, Failure> {
    match (job.state, job.error, job.metrics) {
        (JobState::Succeeded, _, Some(metrics)) => {
            let text = format!("{}\nfetch     tcgs fetch {}", train::text(&metrics), job.id);
            Ok(Report { text, json: whole })
        }
        (JobState::Failed, Some(problem), _) => Err(problem.into()),
        (JobState::Cancelled, ..) => Err(Failure::Stopped),
        (state, ..) => Ok(Report { text: format!("job {} is {}", job.id, state.name()), json: whole }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jobs_are_named_by_id_path_or_address() {
        let id = "01a20055-454e-788e-bcc5-854572fb30d3";
        for text in [id.to_owned(), format!("/v1/jobs/{id}"), format!("http://a.example:8080/v1/jobs/{id}/")]
        {
            assert_eq!(parse(&text).map(|id| id.to_string()), Ok(id.to_owned()), "{text}");
        }
        for text in ["", "17", "/v1/jobs/", "../../etc"] {
            assert!(parse(text).is_err(), "{text}");
        }
    }
}
