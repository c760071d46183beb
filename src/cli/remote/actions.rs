//! `tcgs cancel`, `tcgs retry` and `tcgs delete`: actions on a job of a service.

use std::cell::Cell;

use reqwest::Method;
use serde_json::{Map, json};
use tcgs::domain::{JobState, ProblemType};

use super::{
    connection::document,
    job::{self, JobArgs},
};
use crate::cli::{CliError, Report};

/// Arguments of `tcgs retry`.
#[derive(Debug, clap::Args)]
pub(crate) struct RetryArgs {
    #[command(flatten)]
    pub(crate) of: JobArgs,

    /// Begin at the first step, also if the job left a checkpoint
    #[arg(long)]
    without_checkpoint: bool,

    /// Fail the new job if it has not succeeded after this many seconds
    #[arg(long, value_name = "SECONDS")]
    deadline: Option<u32>,
}

/// Cancels a job that is queued or running.
pub(crate) fn cancel(args: &JobArgs) -> Result<Report, CliError> {
    let connection = args.server.connect()?;
    let path = format!("{}/cancel", job::path(args.job));
    let make = async || connection.request(Method::POST, &path);
    let answer = super::run(async { document(connection.send_with_retry(make).await?).await })?;
    let (whole, job) = job::read(answer)?;
    let text = match job.state {
        JobState::Cancelled => format!("job {} is cancelled", job.id),
        _ => format!("job {} will be cancelled: its worker stops it within seconds", job.id),
    };
    Ok(Report { text, json: whole })
}

/// Queues a failed or cancelled job again, as a new job.
pub(crate) fn retry(args: &RetryArgs) -> Result<Report, CliError> {
    let JobArgs { job, server, .. } = &args.of;
    let connection = server.connect()?;
    let mut request = Map::from_iter([("from_checkpoint".to_owned(), json!(!args.without_checkpoint))]);
    request.extend(args.deadline.map(|seconds| ("deadline_s".to_owned(), json!(seconds))));
    let (path, request) = (format!("{}/retry", job::path(*job)), request.into());
    let made = super::run(async { document(connection.post(&path, &request).await?).await })?;
    let (whole, new) = job::read(made)?;
    Ok(job::created(whole, &new, server))
}

/// Deletes a job that has ended, with its files.
pub(crate) fn delete(args: &JobArgs) -> Result<Report, CliError> {
    let connection = args.server.connect()?;
    let path = job::path(args.job);
    let sent = Cell::new(0);
    let make = async || {
        sent.set(sent.get() + 1);
        connection.request(Method::DELETE, &path)
    };
    match super::run(connection.send_with_retry(make)) {
        Ok(_) => {}
        // An earlier request deleted it, whose answer was lost.
        Err(CliError::Problem(problem)) if sent.get() > 1 && problem.is(ProblemType::JobNotFound) => {}
        Err(error) => return Err(error),
    }
    let text = format!("job {} is deleted", args.job);
    Ok(Report { text, json: json!({ "id": args.job, "deleted": true }) })
}
