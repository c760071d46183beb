//! `tcgs bench`: measurements of this build, one subcommand a file.

mod accuracy;
mod contexts;
mod report;
mod views;

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
    /// Compare contexts: fit and code models of every kind to parts of finished scenes
    Contexts(contexts::Args),
    /// Make a declared matrix of runs and report speed against error
    Report(report::Args),
    /// Count frames a second of a finished scene at several sizes
    Views(views::Args),
}

impl Args {
    /// Whether the answer is to be one JSON document.
    pub(super) fn wants_json(&self) -> bool {
        match &self.bench {
            Bench::Accuracy(args) => args.json,
            Bench::Contexts(args) => args.json,
            Bench::Report(args) => args.json,
            Bench::Views(args) => args.json,
        }
    }
}

/// Runs the measurement.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    match &args.bench {
        Bench::Accuracy(args) => accuracy::run(args),
        Bench::Contexts(args) => contexts::run(args),
        Bench::Report(args) => report::run(args),
        Bench::Views(args) => views::run(args),
    }
}
