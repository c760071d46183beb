//! `tcgs backup`, `tcgs restore` and `tcgs fsck`: copies of a service's data folder, and what is wrong with one.

use std::path::PathBuf;

use tcgs::{
    domain::{Bytes, Problem, ProblemType},
    store::{BackupNote, BucketClaim, CheckDepth, CopyMode, FsckReport},
};

use super::{CliError, Report, storage::StorageFlags, wiring};

/// Arguments of `tcgs backup`.
#[derive(Debug, clap::Args)]
pub(crate) struct BackupArgs {
    /// Folder of the backup, absent or empty
    destination: PathBuf,

    #[command(flatten)]
    storage: StorageFlags,

    /// Copy all files and check their digests, also where a second name for each would do
    #[arg(long)]
    copy: bool,

    /// Print one JSON document instead of text
    #[arg(long)]
    pub(crate) json: bool,
}

/// Arguments of `tcgs restore`.
#[derive(Debug, clap::Args)]
pub(crate) struct RestoreArgs {
    /// Folder of the backup
    backup: PathBuf,

    #[command(flatten)]
    storage: StorageFlags,

    /// Restore into the bucket although another database has it: one that no service uses any more, or one of a restoration that failed
    #[arg(long)]
    take_over_bucket: bool,

    /// Print one JSON document instead of text
    #[arg(long)]
    pub(crate) json: bool,
}

/// Arguments of `tcgs fsck`.
#[derive(Debug, clap::Args)]
pub(crate) struct FsckArgs {
    #[command(flatten)]
    storage: StorageFlags,

    /// Compare the lengths of files only, without reading them
    #[arg(long)]
    lengths: bool,

    /// Print one JSON document instead of text
    #[arg(long)]
    pub(crate) json: bool,
}

/// Writes a backup.
pub(crate) fn backup(args: &BackupArgs) -> Result<Report, CliError> {
    let mode = if args.copy { CopyMode::Content } else { CopyMode::Link };
    let storage = args.storage.storage()?;
    let data = storage.sqlite_folder("backup")?;
    let note = wiring::back_up(&storage, &args.destination, mode)?;
    let text = format!("{} has a backup of {}: {}.", args.destination.display(), data.display(), told(&note));
    Ok(Report::new(text, &note))
}

/// Restores a backup.
pub(crate) fn restore(args: &RestoreArgs) -> Result<Report, CliError> {
    let storage = args.storage.storage()?;
    let data = storage.sqlite_folder("restore")?;
    if args.take_over_bucket && storage.blobs.is_none() {
        return Err(CliError::Usage("--take-over-bucket: name the bucket with --blobs s3://BUCKET".into()));
    }
    let claim = if args.take_over_bucket { BucketClaim::TakeOver } else { BucketClaim::Unclaimed };
    let note = wiring::restore(&args.backup, &storage, claim)?;
    let text = format!("{} has what {} has: {}.", data.display(), args.backup.display(), told(&note));
    Ok(Report::new(text, &note))
}

fn told(note: &BackupNote) -> String {
    format!("{} files of {}, as of {}", note.blobs, Bytes(note.bytes), note.taken_at)
}

/// Checks a data folder; the exit status is 1 if anything is missing or damaged.
pub(crate) fn fsck(args: &FsckArgs) -> Result<Report, CliError> {
    let depth = if args.lengths { CheckDepth::Length } else { CheckDepth::Content };
    let storage = args.storage.storage()?;
    let report = wiring::fsck(&storage, depth)?;
    let told = Report::new(lines(&report), &report);
    if report.is_sound() {
        return Ok(told);
    }
    let detail = format!("{} is damaged: see the report, and restore a backup", storage.data.display());
    let problem = Box::new(Problem::new(ProblemType::DataDamaged, detail));
    Err(CliError::Reported { problem, text: told.text, json: told.json })
}

fn lines(report: &FsckReport) -> String {
    let mut text = String::new();
    for (what, digests) in
        [("missing", &report.missing), ("damaged", &report.damaged), ("orphan", &report.orphans)]
    {
        for digest in digests {
            text += &format!("{what}  {digest}\n");
        }
    }
    for line in &report.database {
        text += &format!("database  {line}\n");
    }
    let depth = if report.content_checked { "" } else { " (lengths only)" };
    text += &format!(
        "{} files of {}{depth}: {} missing, {} damaged; {} orphans.",
        report.blobs,
        Bytes(report.bytes),
        report.missing.len(),
        report.damaged.len(),
        report.orphans.len()
    );
    text
}
