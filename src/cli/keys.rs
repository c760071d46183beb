//! `tcgs keys`: creates, lists and revokes API keys, also while the service runs.

use std::{num::NonZeroU32, path::PathBuf};

use clap::Subcommand;
use serde::Serialize;
use tcgs::{
    domain::{Bytes, KeyId, KeyLimits, Scope},
    store::KeyRecord,
};

use super::{CliError, Report, wiring};

/// Arguments of `tcgs keys`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    action: Action,

    /// Folder of the service's data
    #[arg(long, global = true, value_name = "DIR", default_value = "tcgs-data", env = "TCGS_DATA")]
    data: PathBuf,

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
    /// Revoke a key, from its next request on
    Revoke(RevokeArgs),
}

#[derive(Debug, clap::Args)]
struct CreateArgs {
    /// What the key is for
    #[arg(long)]
    name: String,

    /// Scopes, separated by commas: read, scenes:write, jobs:write, or admin for everything of every owner
    #[arg(long, value_delimiter = ',', default_value = "read,scenes:write,jobs:write")]
    scopes: Vec<Scope>,

    /// Storage for its scenes, uploads and jobs [default: the service's]
    #[arg(long, value_name = "BYTES", alias = "max-bytes")]
    quota_bytes: Option<Bytes>,

    /// Jobs queued or running at the same time [default: the service's]
    #[arg(long, value_name = "N")]
    max_active_jobs: Option<u32>,

    /// Requests per minute [default: the service's]
    #[arg(long, value_name = "N")]
    requests_per_minute: Option<NonZeroU32>,

    /// Highest priority of its jobs, -100 to 100; none for the scope admin [default: the service's]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    max_priority: Option<i32>,
}

#[derive(Debug, clap::Args)]
struct ListArgs {
    /// Show revoked keys too
    #[arg(long)]
    all: bool,
}

#[derive(Debug, clap::Args)]
struct RevokeArgs {
    /// The key's id, as `tcgs keys list` shows it
    id: KeyId,
}

/// Runs the action.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    match &args.action {
        Action::Create(create) => {
            let limits = KeyLimits {
                quota_bytes: create.quota_bytes.map(|bytes| bytes.0),
                max_active_jobs: create.max_active_jobs,
                requests_per_minute: create.requests_per_minute,
                max_priority: create.max_priority,
            };
            let (record, key) = wiring::create_key(&args.data, &create.name, &create.scopes, limits)?;
            let text = format!(
                "{}\n\nThis is the only time that the key is shown. It is '{}', id {}, and allows {}.",
                key.expose(),
                record.name,
                record.id,
                scopes(&record)
            );
            Ok(Report::new(text, &Created { key: key.expose(), record: &record }))
        }
        Action::List(list) => {
            let records = wiring::keys(&args.data, list.all)?;
            Ok(Report::new(table(&records), &serde_json::json!({ "keys": records })))
        }
        Action::Revoke(revoke) => {
            let record = wiring::revoke_key(&args.data, revoke.id)?;
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
    let mut text = format!("{:36}  {:13}  {:28}  {:20}  name\n", "id", "key", "scopes", "last used");
    for record in records {
        let used = match (record.revoked_at, record.last_used_at) {
            (Some(_), _) => "revoked".to_owned(),
            (None, Some(at)) => at.strftime("%Y-%m-%dT%H:%M:%SZ").to_string(),
            (None, None) => "never".to_owned(),
        };
        text += &format!(
            "{}  {:13}  {:28}  {used:20}  {}\n",
            record.id,
            record.prefix,
            scopes(record),
            record.name
        );
    }
    text
}
