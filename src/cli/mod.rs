//! The commands of `tcgs`, one file each.
//!
//! What always holds: a command returns a [`Report`] or a [`CliError`] and prints nothing on standard output itself,
//! so with `--json` exactly one JSON document appears there, also when the command fails. Progress and logs go to
//! standard error, by [`notice`] alone. Output files appear whole or not at all.

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout))]

mod adapter;
mod backup;
mod bench;
mod camera;
mod camera_search;
mod check;
mod config;
mod decode;
mod doctor;
mod encode;
mod error;
mod estimate;
mod eval;
mod export;
mod export_page;
mod files;
mod help;
mod inspect;
mod json_lines;
mod keys;
mod limits;
mod listen;
mod logging;
mod lpips;
mod memory;
mod migrate;
mod notice;
mod options;
mod picture;
#[cfg(debug_assertions)]
mod planned_failure;
mod pose;
mod poses;
mod priority;
mod profile;
mod progress;
mod projects;
mod reading;
mod remote;
mod render;
mod report;
mod sample;
mod serve;
mod signals;
mod storage;
mod train;
mod variables;
mod view_memory;
mod viewer;
mod wiring;
mod worker;

use std::process::ExitCode;

use clap::{CommandFactory as _, FromArgMatches as _, Parser, Subcommand};

use error::CliError;
use logging::{Format, Verbosity};
use report::Report;

/// Trains Gaussian-splatting scenes from posed photographs, compresses each into one self-contained file, and serves
/// them over HTTP.
#[derive(Debug, Parser)]
#[command(name = "tcgs", version, propagate_version = true, after_help = EXIT_STATUSES)]
struct Cli {
    /// How log lines on standard error are written: text or json (which ones: RUST_LOG)
    #[arg(
        long,
        global = true,
        value_enum,
        default_value_t = Format::Text,
        env = "TCGS_LOG_FORMAT",
        hide_possible_values = true,
        display_order = 1000
    )]
    log_format: Format,

    #[command(subcommand)]
    command: Command,
}

const EXIT_STATUSES: &str = "Exit status: 0 done; 2 wrong usage; 3 the input was refused; \
    4 a resource was missing or spent; 130 or 143 stopped by a signal; 1 anything else.";

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the HTTP service with its own worker process
    Serve(Box<serve::Args>),
    /// Take jobs from a queue and carry them out
    Worker(worker::Args),
    /// Render views and exports for API replicas that share a database and blobs
    Viewer(viewer::Args),
    /// Find the cameras of photographs and make a dataset of them
    Poses(poses::Args),
    /// Check a dataset and show what it holds
    Check(check::Args),
    /// Train a scene from a dataset and write it as one compressed file
    Train(train::Args),
    /// Write decoded attributes (as `decode` writes them) as a compressed file
    Encode(encode::Args),
    /// Write the attributes that a file decodes to, and print their hash
    Decode(decode::Args),
    /// Render a view of a file
    Render(render::Args),
    /// Measure a file on the held-out views of its dataset
    Eval(eval::Args),
    /// Write a scene as plain Gaussians for other programs, and say what that costs
    Export(export::Args),
    /// Show where each byte of a file goes
    Inspect(inspect::Args),
    /// Send a dataset to a service as a job
    Submit(remote::submit::Args),
    /// Follow a job of a service to its end
    Watch(remote::JobArgs),
    /// Download the file of a job of a service
    Fetch(remote::fetch::Args),
    /// List the jobs of a service, newest first
    Jobs(remote::jobs::Args),
    /// Cancel a job of a service
    Cancel(remote::JobArgs),
    /// Queue a job of a service again, also with other options
    Retry(remote::actions::RetryArgs),
    /// Delete an ended job of a service with its files
    Delete(remote::JobArgs),
    /// Save a view of a job's scene that the service renders
    View(remote::view::Args),
    /// Write the bundled ray-traced scene as a dataset
    Sample(sample::Args),
    /// Make, list, change and revoke the API keys of a service
    Keys(keys::Args),
    /// Make, list and change the projects of a service
    Projects(projects::Args),
    /// Bring the database of a service up to this version
    Migrate(migrate::Args),
    /// Measure this build on an adapter
    Bench(bench::Args),
    /// Copy the data of a service, also while it runs
    Backup(backup::BackupArgs),
    /// Make a data folder of a backup
    Restore(backup::RestoreArgs),
    /// Check the data of a service for missing, damaged and unreferenced files
    Fsck(backup::FsckArgs),
    /// Show what this machine offers, and what is missing
    Doctor(doctor::Args),
}

impl Command {
    /// Whether the answer is to be one JSON document.
    fn wants_json(&self) -> bool {
        match self {
            Command::Poses(args) => args.json,
            Command::Check(args) => args.json,
            Command::Train(args) => args.json,
            Command::Decode(args) => args.json,
            Command::Eval(args) => args.json,
            Command::Export(args) => args.json,
            Command::Inspect(args) => args.json,
            Command::Keys(args) => args.json,
            Command::Projects(args) => args.json,
            Command::Migrate(args) => args.json,
            Command::Backup(args) => args.json,
            Command::Restore(args) => args.json,
            Command::Fsck(args) => args.json,
            Command::Bench(args) => args.wants_json(),
            Command::Doctor(args) => args.json,
            Command::Submit(args) => args.json,
            Command::Watch(args) => args.json,
            Command::Fetch(args) => args.json,
            Command::Jobs(args) => args.json,
            Command::Cancel(args) | Command::Delete(args) => args.json,
            Command::Retry(args) => args.of.json,
            Command::Serve(_)
            | Command::Worker(_)
            | Command::Viewer(_)
            | Command::Encode(_)
            | Command::Render(_)
            | Command::View(_)
            | Command::Sample(_) => false,
        }
    }

    /// The flags of a service's settings; none for single commands.
    fn service(&self) -> Option<&config::ConfigFlags> {
        match self {
            Command::Serve(args) => Some(&args.config),
            Command::Worker(args) => Some(&args.config),
            Command::Viewer(args) => Some(&args.config),
            _ => None,
        }
    }

    /// Services tell what they do; single commands speak up only when something is off.
    fn verbosity(&self) -> Verbosity {
        if self.service().is_some() { Verbosity::Info } else { Verbosity::Warn }
    }

    fn run(self, log_format: Format) -> Result<Report, CliError> {
        match self {
            Command::Serve(args) => serve::run(*args, log_format),
            Command::Worker(args) => worker::run(args),
            Command::Viewer(args) => viewer::run(args),
            Command::Poses(args) => poses::run(&args),
            Command::Check(args) => check::run(&args),
            Command::Train(args) => train::run(&args),
            Command::Encode(args) => encode::run(&args),
            Command::Decode(args) => decode::run(&args),
            Command::Render(args) => render::run(&args),
            Command::Eval(args) => eval::run(&args),
            Command::Export(args) => export::run(&args),
            Command::Inspect(args) => inspect::run(&args),
            Command::Submit(args) => remote::submit::run(&args),
            Command::Watch(args) => remote::watch::run(&args),
            Command::Fetch(args) => remote::fetch::run(&args),
            Command::Jobs(args) => remote::jobs::run(&args),
            Command::Cancel(args) => remote::actions::cancel(&args),
            Command::Retry(args) => remote::actions::retry(&args),
            Command::Delete(args) => remote::actions::delete(&args),
            Command::View(args) => remote::view::run(&args),
            Command::Sample(args) => sample::run(&args),
            Command::Keys(args) => keys::run(&args),
            Command::Projects(args) => projects::run(&args),
            Command::Migrate(args) => migrate::run(&args),
            Command::Backup(args) => backup::backup(&args),
            Command::Restore(args) => backup::restore(&args),
            Command::Fsck(args) => backup::fsck(&args),
            Command::Bench(args) => bench::run(&args),
            Command::Doctor(args) => doctor::run(&args),
        }
    }
}

/// Parses the arguments, runs the command, prints what came of it.
pub(crate) fn main() -> ExitCode {
    let settings = match config::parse(help::arranged(Cli::command()), std::env::args_os()) {
        Ok(settings) => settings,
        Err(failure) => return report::conclude(Err(failure), false),
    };
    // The same parsers have taken every value already.
    let cli = Cli::from_arg_matches(&settings.matches).unwrap_or_else(|error| error.exit());
    if cli.command.service().is_some_and(|config| config.print_config) {
        return report::conclude(Ok(settings.printed()), false);
    }
    logging::start(cli.log_format, cli.command.verbosity());
    if cli.command.service().is_some() {
        for variable in variables::unread(&Cli::command()) {
            tracing::warn!(
                "the environment variable {variable} is none of this program; --help lists those that it reads"
            );
        }
    }
    #[cfg(debug_assertions)]
    planned_failure::follow_plan();
    let json = cli.command.wants_json();
    report::conclude(cli.command.run(cli.log_format), json)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_flags_are_consistent() {
        Cli::command().debug_assert();
    }
}
