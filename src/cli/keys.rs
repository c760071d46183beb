//! `tcgs keys`: creates, lists, changes and revokes API keys, also while the service runs.

use std::num::NonZeroU32;

use clap::Subcommand;
use jiff::Timestamp;
use serde::Serialize;
use tcgs::{
    domain::{Clock as _, KeyId, ProjectId, ProjectLimits, Scope, SystemClock},
    store::{KeyChange, KeyProject, KeyRecord, KeyRequest},
};

use super::{
    CliError, Report,
    notice::notice,
    projects::{OrNone, ProjectLimitFlags},
    storage::StorageFlags,
    wiring,
};

/// The name of [`ProjectId::DEFAULT`].
const DEFAULT_PROJECT: &str = "default";

/// Arguments of `tcgs keys`.
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
    /// Create a key and print it once
    ///
    /// From the first key on, the service requires one, also after the key is revoked.
    Create(CreateArgs),
    /// Show the keys, newest first
    List(ListArgs),
    /// Change the name, rate or expiry of a key
    Change(ChangeArgs),
    /// Revoke a key, from its next request on
    Revoke(RevokeArgs),
}

#[derive(Debug, clap::Args)]
struct CreateArgs {
    /// What the key is for
    #[arg(long)]
    name: String,

    /// Scopes, separated by commas: read, datasets:write (also scenes:write), jobs:write, or admin for everything of every
    /// project
    #[arg(long, value_delimiter = ',', default_value = "read,datasets:write,jobs:write", value_parser = scope)]
    scopes: Vec<Scope>,

    /// Project that it belongs to: an id as `tcgs projects list` shows it, or `default`, which has what was made without a key
    /// [default: a new one with the key's name]
    #[arg(long, value_name = "ID|default", value_parser = project)]
    project: Option<ProjectId>,

    /// When it expires, as 2027-01-31T00:00:00Z [default: never]
    #[arg(long, value_name = "INSTANT")]
    expires_at: Option<Timestamp>,

    /// Requests per minute [default: the service's]
    #[arg(long, value_name = "N")]
    requests_per_minute: Option<NonZeroU32>,

    #[command(flatten, next_help_heading = "Limits of its new project")]
    limits: ProjectLimitFlags,
}

#[derive(Debug, clap::Args)]
struct ChangeArgs {
    /// The key's id, as `tcgs keys list` shows it
    id: KeyId,

    /// Its new name
    #[arg(long)]
    name: Option<String>,

    /// When it expires; none for never
    #[arg(long, value_name = "INSTANT|none")]
    expires_at: Option<OrNone<Timestamp>>,

    /// Requests per minute; none for the service's default
    #[arg(long, value_name = "N|none")]
    requests_per_minute: Option<OrNone<NonZeroU32>>,
}

#[derive(Debug, clap::Args)]
struct ListArgs {
    /// Show revoked keys too
    #[arg(long)]
    all: bool,

    /// Show the keys of this project alone
    #[arg(long, value_name = "ID|default", value_parser = project)]
    project: Option<ProjectId>,
}

#[derive(Debug, clap::Args)]
struct RevokeArgs {
    /// The key's id, as `tcgs keys list` shows it
    id: KeyId,
}

/// A scope by its name, or by a name that means the same.
fn scope(text: &str) -> Result<Scope, String> {
    if text == "datasets:write" { Ok(Scope::DatasetsWrite) } else { text.parse() }
}

/// A project's id, or that of the project of everything that was made without a key.
fn project(text: &str) -> Result<ProjectId, String> {
    if text == DEFAULT_PROJECT {
        return Ok(ProjectId::DEFAULT);
    }
    text.parse().map_err(|error| {
        format!("{error}; it is an id as `tcgs projects list` shows it, or {DEFAULT_PROJECT}")
    })
}

/// Says what the first key changes: from now on the service requires one, and the new key may not see what was made without one.
fn note_first_key(before: &wiring::WithoutKeys, record: &KeyRecord) {
    if !before.is_open {
        return;
    }
    notice(format_args!("tcgs: note: from now on every request needs a key"));
    if record.project_id != ProjectId::DEFAULT && !record.allows(Scope::Admin) && before.jobs > 0 {
        let jobs = if before.jobs == 1 { "1 job is".to_owned() } else { format!("{} jobs are", before.jobs) };
        notice(format_args!(
            "tcgs: note: {jobs} of the project {DEFAULT_PROJECT}, which this key does not see; for a key that does: \
             tcgs keys create --name NAME --project {DEFAULT_PROJECT}"
        ));
    }
}

/// Runs the action.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let storage = args.storage.storage()?;
    match &args.action {
        Action::Create(create) => {
            let limits = create.limits.limits();
            let project = match create.project {
                None => KeyProject::New(limits),
                Some(id) if limits == ProjectLimits::default() => KeyProject::Existing(id),
                Some(id) => {
                    let error = "storage, numbers of jobs and priority are limits of projects, not of keys";
                    return Err(CliError::Usage(format!("{error}; set them by 'tcgs projects change {id}'")));
                }
            };
            let request = KeyRequest {
                name: &create.name,
                scopes: &create.scopes,
                project,
                expires_at: create.expires_at,
                requests_per_minute: create.requests_per_minute,
            };
            let before = wiring::without_keys(&storage)?;
            let (record, key) = wiring::create_key(&storage, request)?;
            note_first_key(&before, &record);
            let text = format!(
                "{}\n\nThis is the only time that the key is shown. It is '{}', id {}, of project {}, and \
                 allows {}.",
                key.expose(),
                record.name,
                record.id,
                record.project_id,
                scopes(&record)
            );
            Ok(Report::new(text, &Created { key: key.expose(), record: &record }))
        }
        Action::List(list) => {
            let records = wiring::keys(&storage, list.project, list.all)?;
            Ok(Report::new(table(&records), &serde_json::json!({ "keys": records })))
        }
        Action::Change(wanted) => {
            let change = KeyChange {
                name: wanted.name.clone(),
                requests_per_minute: wanted.requests_per_minute.map(|new| new.0),
                expires_at: wanted.expires_at.map(|new| new.0),
            };
            let record = wiring::change_key(&storage, wanted.id, change)?;
            let text = format!("The key '{}' ({}...) is changed.", record.name, record.prefix);
            Ok(Report::new(text, &record))
        }
        Action::Revoke(revoke) => {
            let record = wiring::revoke_key(&storage, revoke.id)?;
            let text = format!("The key '{}' ({}...) is revoked.", record.name, record.prefix);
            Ok(Report::new(text, &record))
        }
    }
}

#[derive(Serialize)]
struct Created<'a> {
    key: &'a str,
    #[serde(flatten)]
    record: &'a KeyRecord,
}

fn scopes(record: &KeyRecord) -> String {
    record.scopes.iter().map(|scope| scope.name()).collect::<Vec<_>>().join(",")
}

fn table(records: &[KeyRecord]) -> String {
    if records.is_empty() {
        return "There are no keys.".to_owned();
    }
    let mut text =
        format!("{:36}  {:13}  {:36}  {:28}  {:20}  name\n", "id", "key", "project", "scopes", "last used");
    for record in records {
        let instant = |at: Timestamp| at.strftime("%Y-%m-%dT%H:%M:%SZ").to_string();
        let used = match (record.revoked_at, record.last_used_at) {
            (Some(_), _) => "revoked".to_owned(),
            (None, _) if !record.is_valid(SystemClock.now()) => "expired".to_owned(),
            (None, Some(at)) => instant(at),
            (None, None) => "never".to_owned(),
        };
        text += &format!(
            "{}  {:13}  {}  {:28}  {used:20}  {}\n",
            record.id,
            record.prefix,
            record.project_id,
            scopes(record),
            record.name
        );
    }
    text
}
