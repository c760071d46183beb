//! `tcgs jobs`: the jobs of a service, newest first.

use jiff::Timestamp;
use serde::Deserialize;
use serde_json::{Value, json};
use tcgs::domain::{JobState, problem::TYPE_PREFIX};

use super::{Connection, ServerFlags, connection::unexpected, job::JobView};
use crate::cli::{CliError, Report};

/// Most jobs of a page, as the service has it.
const PAGE: usize = 100;

/// Arguments of `tcgs jobs`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Only jobs in these states, separated by commas: queued, running, succeeded, failed, cancelled
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    state: Vec<JobState>,

    /// Most jobs to show, the newest
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    limit: u32,

    #[command(flatten)]
    server: ServerFlags,

    /// Print the jobs as one JSON document
    #[arg(long)]
    pub(crate) json: bool,
}

/// Lists the jobs that the key may see.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let connection = args.server.connect()?;
    let (jobs, more) = super::run(list(&connection, &args.state, args.limit as usize))?;
    // A newer service may have jobs that only programs can read.
    let text = if args.json { String::new() } else { table(&jobs, more)? };
    Ok(Report { text, json: json!({ "jobs": jobs, "more": more }) })
}

/// A page of the service's list.
#[derive(Debug, Deserialize)]
struct JobPage {
    jobs: Vec<Value>,
    /// Path of the next page.
    next: Option<String>,
}

/// At most `limit` jobs, and whether there are more.
async fn list(
    connection: &Connection,
    states: &[JobState],
    limit: usize,
) -> Result<(Vec<Value>, bool), CliError> {
    let mut path = format!("/v1/jobs?limit={}", limit.min(PAGE));
    if !states.is_empty() {
        let names: Vec<&str> = states.iter().map(|state| state.name()).collect();
        path += &format!("&state={}", names.join(","));
    }
    let mut jobs = Vec::new();
    loop {
        let page: JobPage = connection.get(&path).await?;
        let is_empty = page.jobs.is_empty();
        jobs.extend(page.jobs);
        match page.next {
            // A service that sends empty pages must not be asked for ever.
            Some(next) if jobs.len() < limit && !is_empty => path = next,
            next => {
                let more = next.is_some() || jobs.len() > limit;
                jobs.truncate(limit);
                return Ok((jobs, more));
            }
        }
    }
}

/// The fields of a listed job that the other commands do not use.
#[derive(Debug, Deserialize)]
struct Listed {
    name: Option<String>,
    queue_position: Option<u32>,
    cancel_requested: bool,
    created_at: Timestamp,
}

/// How far a job is, or what came of it.
fn progress(job: &JobView, listed: &Listed) -> String {
    let JobView { state, phase, progress, metrics, error, .. } = job;
    match (state, metrics, error) {
        (JobState::Queued, ..) => {
            listed.queue_position.map_or_else(String::new, |position| format!("position {position}"))
        }
        (JobState::Running, ..) if listed.cancel_requested => "to be cancelled".to_owned(),
        (JobState::Running, ..) if progress.total > 0 => {
            format!("{} {}/{}", phase.name(), progress.step, progress.total)
        }
        (JobState::Running, ..) => phase.name().to_owned(),
        (JobState::Succeeded, Some(metrics), _) => {
            let psnr = metrics.test.psnr.map_or_else(String::new, |psnr| format!("{psnr:.2} dB, "));
            format!("{psnr}{} bytes", metrics.bytes.total)
        }
        (JobState::Failed, _, Some(problem)) => {
            problem.kind.strip_prefix(TYPE_PREFIX).unwrap_or(&problem.kind).to_owned()
        }
        _ => String::new(),
    }
}

fn row(job: &Value) -> Result<String, serde_json::Error> {
    let (view, listed) = (JobView::deserialize(job)?, Listed::deserialize(job)?);
    Ok(format!(
        "{}  {:9}  {}  {:24}  {}",
        view.id,
        view.state,
        listed.created_at.strftime("%Y-%m-%dT%H:%M:%SZ"),
        progress(&view, &listed),
        listed.name.as_deref().unwrap_or_default()
    ))
}

fn table(jobs: &[Value], more: bool) -> Result<String, CliError> {
    if jobs.is_empty() {
        return Ok("There are no jobs.".to_owned());
    }
    let mut text = format!("{:36}  {:9}  {:20}  {:24}  name\n", "id", "state", "created", "progress");
    for job in jobs {
        let row =
            row(job).map_err(|error| unexpected(format!("its list of jobs cannot be read: {error}")))?;
        // Most jobs have no name.
        text += row.trim_end();
        text.push('\n');
    }
    if more {
        text += "There are more; see --limit and --state.";
    }
    Ok(text)
}
