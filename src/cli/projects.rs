//! `tcgs projects`: creates, lists and changes projects, also while the service runs.

use std::str::FromStr;

use clap::Subcommand;
use serde_json::{Value, json};
use tcgs::{
    domain::{Bytes, JobState, ProjectId, ProjectLimits},
    store::{ProjectChange, ProjectUsage},
};

use super::{CliError, Report, storage::StorageFlags, wiring};

/// The flag that bounds running jobs, of services and workers.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct MaxRunningFlag {
    /// Jobs of a project running at the same time, if it has no limit of its own [default: unlimited]
    #[arg(long, value_name = "N", env = "TCGS_MAX_RUNNING_JOBS")]
    pub(crate) max_running_jobs: Option<u32>,
}

/// A value, or `none` to remove it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct OrNone<T>(pub(crate) Option<T>);

impl<T: FromStr> FromStr for OrNone<T> {
    type Err = T::Err;

    fn from_str(text: &str) -> Result<Self, T::Err> {
        if text == "none" { Ok(Self(None)) } else { text.parse().map(|value| Self(Some(value))) }
    }
}

/// The limits of a project to be created.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct ProjectLimitFlags {
    /// Storage for its scenes, uploads and jobs [default: the service's]
    #[arg(long, value_name = "BYTES", alias = "max-bytes")]
    quota_bytes: Option<Bytes>,

    /// Its jobs queued or running at the same time [default: the service's]
    #[arg(long, value_name = "N")]
    max_active_jobs: Option<u32>,

    /// Its jobs running at the same time [default: the service's]
    #[arg(long, value_name = "N")]
    max_running_jobs: Option<u32>,

    /// Highest priority of its jobs, -100 to 100; none for keys with the scope admin [default: the service's]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    max_priority: Option<i32>,
}

impl ProjectLimitFlags {
    pub(crate) fn limits(self) -> ProjectLimits {
        ProjectLimits {
            quota_bytes: self.quota_bytes.map(|bytes| bytes.0),
            max_active_jobs: self.max_active_jobs,
            max_running_jobs: self.max_running_jobs,
            max_priority: self.max_priority,
        }
    }
}

/// Arguments of `tcgs projects`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    action: Action,

    #[command(flatten)]
    storage: StorageFlags,

    /// Print one JSON document instead of text
    #[arg(long, global = true)]
    pub(crate) json: bool,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Create a project
    Create(CreateArgs),
    /// Show the projects with what they use, newest first
    List,
    /// Change the name or limits of a project
    Change(ChangeArgs),
}

#[derive(Debug, clap::Args)]
struct CreateArgs {
    /// What the project is for
    #[arg(long)]
    name: String,

    #[command(flatten)]
    limits: ProjectLimitFlags,
}

#[derive(Debug, clap::Args)]
struct ChangeArgs {
    /// The project's id, as `tcgs projects list` shows it
    id: ProjectId,

    /// Its new name
    #[arg(long)]
    name: Option<String>,

    /// Storage for its scenes, uploads and jobs; none for the service's default
    #[arg(long, value_name = "BYTES|none")]
    quota_bytes: Option<OrNone<Bytes>>,

    /// Its jobs queued or running at the same time; none for the service's default
    #[arg(long, value_name = "N|none")]
    max_active_jobs: Option<OrNone<u32>>,

    /// Its jobs running at the same time; none for the service's default
    #[arg(long, value_name = "N|none")]
    max_running_jobs: Option<OrNone<u32>>,

    /// Highest priority of its jobs, -100 to 100; none for the service's default
    #[arg(long, value_name = "N|none", allow_negative_numbers = true)]
    max_priority: Option<OrNone<i32>>,
}

/// Runs the action.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let storage = args.storage.storage()?;
    match &args.action {
        Action::Create(create) => {
            let record = wiring::create_project(&storage, &create.name, create.limits.limits())?;
            let text = format!("Project '{}' is created, id {}.", record.name, record.id);
            Ok(Report::new(text, &record))
        }
        Action::List => {
            let all = wiring::projects(&storage)?;
            let projects: Value = all.iter().map(listed).collect();
            Ok(Report::new(table(&all), &json!({ "projects": projects })))
        }
        Action::Change(wanted) => {
            let record = wiring::change_project(&storage, wanted.id, |record| {
                let limits = record.limits;
                ProjectChange {
                    name: wanted.name.clone().unwrap_or_else(|| record.name.clone()),
                    limits: ProjectLimits {
                        quota_bytes: wanted
                            .quota_bytes
                            .map_or(limits.quota_bytes, |new| new.0.map(|bytes| bytes.0)),
                        max_active_jobs: wanted.max_active_jobs.map_or(limits.max_active_jobs, |new| new.0),
                        max_running_jobs: wanted
                            .max_running_jobs
                            .map_or(limits.max_running_jobs, |new| new.0),
                        max_priority: wanted.max_priority.map_or(limits.max_priority, |new| new.0),
                    },
                }
            })?;
            let text = format!("Project '{}' ({}) is changed.", record.name, record.id);
            Ok(Report::new(text, &record))
        }
    }
}

/// A project of the list.
fn listed(usage: &ProjectUsage) -> Value {
    json!({
        "project_id": usage.project.id,
        "name": usage.project.name,
        "stored_bytes": usage.stored,
        "upload_bytes": usage.reserved,
        "queued_jobs": jobs(usage, JobState::Queued),
        "running_jobs": jobs(usage, JobState::Running),
        "worker_seconds": usage.worker_seconds,
        "limits": usage.project.limits,
    })
}

fn jobs(usage: &ProjectUsage, state: JobState) -> u64 {
    usage.jobs.iter().find(|(counted, _)| *counted == state).map_or(0, |(_, count)| *count)
}

fn table(all: &[ProjectUsage]) -> String {
    let mut text = format!(
        "{:36}  {:>15}  {:>7}  {:>7}  {:>12}  name\n",
        "id", "bytes", "queued", "running", "worker s"
    );
    for usage in all {
        text += &format!(
            "{}  {:>15}  {:>7}  {:>7}  {:>12.0}  {}\n",
            usage.project.id,
            usage.stored.total() + usage.reserved,
            jobs(usage, JobState::Queued),
            jobs(usage, JobState::Running),
            usage.worker_seconds,
            usage.project.name
        );
    }
    text
}
