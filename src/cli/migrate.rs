//! `tcgs migrate`: brings the schema of a service's database up to date without starting the service.

use std::path::PathBuf;

use tcgs::store::SchemaChange;

use super::{CliError, Report, wiring};

/// Arguments of `tcgs migrate`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder of the service's data
    #[arg(long, value_name = "DIR", default_value = "tcgs-data", env = "TCGS_DATA")]
    data: PathBuf,

    /// Print one JSON document instead of text
    #[arg(long)]
    pub(crate) json: bool,
}

/// Brings the schema up to date.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let change = wiring::migrate(&args.data)?;
    let folder = args.data.display();
    let text = match change {
        SchemaChange { from: None, to } => {
            format!("A new database in {folder} has the schema of version {to}.")
        }
        SchemaChange { from: Some(from), to } if from == to => {
            format!("The schema of the database in {folder} has version {to} already.")
        }
        SchemaChange { from: Some(from), to } => {
            format!("The schema of the database in {folder} was brought from version {from} to {to}.")
        }
    };
    Ok(Report::new(text, &change))
}
