//! `tcgs inspect`: where each byte of a file goes.

use std::path::PathBuf;

use super::{Failure, Report, files, wiring};

/// Arguments of `tcgs inspect`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The compressed file
    file: PathBuf,

    /// Print one JSON document
    #[arg(long)]
    pub(super) json: bool,
}

/// Accounts for the file.
pub(crate) fn run(args: &Args) -> Result<Report, Failure> {
    let inspection = wiring::inspect(&files::read(&args.file)?)
        .map_err(|problem| problem.in_file(args.file.display().to_string()))?;
    Ok(Report { text: inspection.text, json: inspection.json })
}
