//! `tcgs migrate`: brings the schema of a service's database up to date without starting the service.

use tcgs::store::SchemaChange;

use super::{CliError, Report, storage::StorageFlags, wiring};

/// Arguments of `tcgs migrate`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    storage: StorageFlags,

    /// Print one JSON document instead of text
    #[arg(long)]
    pub(crate) json: bool,
}

/// Brings the schema up to date.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let storage = args.storage.storage()?;
    let change = wiring::migrate(&storage)?;
    let text = match change {
        SchemaChange { from: None, to } => {
            format!("A new database in {storage} has the schema of version {to}.")
        }
        SchemaChange { from: Some(from), to } if from == to => {
            format!("The schema of the database in {storage} has version {to} already.")
        }
        SchemaChange { from: Some(from), to } => {
            format!("The schema of the database in {storage} was brought from version {from} to {to}.")
        }
    };
    Ok(Report::new(text, &change))
}
