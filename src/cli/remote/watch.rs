//! `tcgs watch`: shows a job's progress until it has ended.

use tcgs::domain::JobId;

use super::{ServerFlags, follow::follow, job};
use crate::cli::{CliError, Report};

/// Arguments of `tcgs watch`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The job: its id, or an address that ends with it
    #[arg(value_parser = job::parse)]
    job: JobId,

    #[command(flatten)]
    server: ServerFlags,

    /// Print the finished job as one JSON document
    #[arg(long)]
    pub(crate) json: bool,
}

/// Follows the job; its failure is the command's.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let connection = args.server.connect()?;
    let (whole, job) = super::run(follow(&connection, args.job, &args.server))?;
    job::conclude(whole, job, &args.server)
}
