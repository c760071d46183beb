//! `tcgs bench`: measurements of this build, one subcommand a file.

mod accuracy;

use clap::Subcommand;

use super::{CliError, Report};

/// Arguments of `tcgs bench`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    bench: Bench,
}

#[derive(Debug, Subcommand)]
enum Bench {
    /// Compare the kernels with f64 on hard cases, each with a bound
    Accuracy(accuracy::Args),
}

impl Args {
    /// Whether the answer is to be one JSON document.
    pub(super) fn wants_json(&self) -> bool {
        match &self.bench {
            Bench::Accuracy(args) => args.json,
        }
    }
}

/// Runs the measurement.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    match &args.bench {
        Bench::Accuracy(args) => accuracy::run(args),
    }
}
