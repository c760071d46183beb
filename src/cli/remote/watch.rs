//! `tcgs watch`: shows a job's progress until it has ended.

use super::{
    follow::follow,
    job::{self, JobArgs},
};
use crate::cli::{CliError, Report};

/// Follows the job; its failure is the command's.
pub(crate) fn run(args: &JobArgs) -> Result<Report, CliError> {
    let connection = args.server.connect()?;
    let (whole, job) = super::run(follow(&connection, args.job, &args.server))?;
    job::conclude(whole, job, &args.server)
}
