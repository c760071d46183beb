//! Jobs of a service, and how the command line names them.

use serde::Deserialize;
use serde_json::Value;
use tcgs::domain::{JobId, JobMetrics, JobState, Phase, Problem, ProblemType, Progress};

use super::{Connection, ServerFlags};
use crate::cli::{CliError, Report, train};

/// Arguments of `tcgs watch`, `tcgs cancel` and `tcgs delete`.
#[derive(Debug, clap::Args)]
pub(crate) struct JobArgs {
    /// The job: its id, or an address that ends with it
    #[arg(value_parser = parse)]
    pub(super) job: JobId,

    #[command(flatten)]
    pub(super) server: ServerFlags,

    /// Print the outcome as one JSON document
    #[arg(long)]
    pub(crate) json: bool,
}

/// The fields of a job that the commands use.
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

/// Reads a job's id, or a path or address that ends with it.
pub(super) fn parse(text: &str) -> Result<JobId, String> {
    let name = text.trim_end_matches('/').rsplit('/').next().unwrap_or_default();
    name.parse().map_err(|_| format!("'{text}' is not a job id"))
}

/// The path of a job.
pub(super) fn path(job: JobId) -> String {
    format!("/v1/jobs/{job}")
}

/// The job as JSON and as the fields that the commands use.
pub(super) async fn get(connection: &Connection, job: JobId) -> Result<(Value, JobView), CliError> {
    read(connection.get(&path(job)).await?)
}

/// As [`get`], from JSON.
pub(super) fn read(whole: Value) -> Result<(Value, JobView), CliError> {
    let view = JobView::deserialize(&whole)
        .map_err(|error| super::connection::unexpected(format!("its job cannot be read: {error}")))?;
    Ok((whole, view))
}

/// The report of a job that was created.
pub(super) fn created(whole: Value, job: &JobView, server: &ServerFlags) -> Report {
    let watch = server.command_line(&format!("watch {}", job.id));
    let report = server.address(&format!("{}/report", path(job.id)));
    Report { text: format!("job {}\nwatch     {watch}\nreport    {report}", job.id), json: whole }
}

/// The outcome of a finished job: its metrics, or its problem as the command's own.
pub(super) fn conclude(whole: Value, job: JobView, server: &ServerFlags) -> Result<Report, CliError> {
    match (job.state, job.error, job.metrics) {
        (JobState::Succeeded, _, Some(metrics)) => {
            // What `fetch` takes without `--lambda`; the kind of a file is also its extension.
            let extension = job.artifacts.first().map_or("tcgs", |file| &file.kind);
            let fetch = server.command_line(&format!("fetch {} -o scene.{extension}", job.id));
            let page = |name: &str| server.address(&format!("{}/{name}", path(job.id)));
            let (viewer, report) = (page("viewer"), page("report"));
            let text = format!(
                "{}\nfetch     {fetch}\nviewer    {viewer}\nreport    {report}",
                train::text(&metrics)
            );
            Ok(Report { text, json: whole })
        }
        (JobState::Failed, Some(problem), _) => Err(problem.into()),
        (JobState::Cancelled, ..) => {
            let retry = server.command_line(&format!("retry {}", job.id));
            let detail = format!("job {} has no file; '{retry}' queues it again", job.id);
            Err(Problem::new(ProblemType::JobCancelled, detail).into())
        }
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
