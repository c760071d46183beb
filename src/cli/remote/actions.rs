//! `tcgs cancel`, `tcgs retry` and `tcgs delete`: actions on a job of a service.

use std::cell::Cell;

use reqwest::Method;
use serde_json::{Map, Value, json};
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

    /// Option to change, by its name in the API, as in --set lambda=0.002; the others stay, and training begins at the first step
    #[arg(long, value_name = "NAME=VALUE", value_parser = change)]
    set: Vec<(String, Value)>,

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

/// Queues a job again that has ended, as a new job.
pub(crate) fn retry(args: &RetryArgs) -> Result<Report, CliError> {
    let JobArgs { job, server, .. } = &args.of;
    let connection = server.connect()?;
    let (path, request) = (format!("{}/retry", job::path(*job)), request(args).into());
    let made = super::run(async { document(connection.post(&path, &request).await?).await })?;
    let (whole, new) = job::read(made)?;
    Ok(job::created(whole, &new, server))
}

/// The body of a retry's request.
fn request(args: &RetryArgs) -> Map<String, Value> {
    let from_checkpoint = !args.without_checkpoint && args.set.is_empty();
    let mut request = Map::from_iter([("from_checkpoint".to_owned(), json!(from_checkpoint))]);
    request.extend(args.deadline.map(|seconds| ("deadline_s".to_owned(), json!(seconds))));
    request.extend(args.set.iter().cloned());
    request
}

/// A changed option: numbers, `true`, `false` and `null` as in JSON, else a text.
fn change(text: &str) -> Result<(String, Value), String> {
    let (name, value) = text.split_once('=').ok_or("write NAME=VALUE, as in lambda=0.002")?;
    let plain = serde_json::from_str(value).ok();
    let plain = plain.filter(|value: &Value| value.is_number() || value.is_boolean() || value.is_null());
    Ok((name.to_owned(), plain.unwrap_or_else(|| value.into())))
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

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        args: RetryArgs,
    }

    #[test]
    fn a_retry_states_the_options_that_change() {
        let of = |flags: &[&str]| {
            let job = "01a20055-454e-788e-bcc5-854572fb30d3";
            Line::try_parse_from([&["retry", job], flags].concat())
                .map(|line| Value::from(request(&line.args)))
        };
        assert_eq!(of(&[]).expect("parses"), json!({ "from_checkpoint": true }));
        let changed = of(&[
            "--set",
            "lambda=0.002",
            "--set",
            "preset=standard",
            "--set",
            "max_bytes=null",
            "--deadline",
            "60",
        ]);
        let expected = json!({
            "from_checkpoint": false, "lambda": 0.002, "preset": "standard", "max_bytes": null, "deadline_s": 60,
        });
        assert_eq!(changed.expect("parses"), expected);
        assert!(of(&["--set", "lambda"]).expect_err("no value").to_string().contains("lambda=0.002"));
    }
}
