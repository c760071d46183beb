//! Where the checkpoints of running jobs are, and their removal once nobody can need them.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use super::run::{Checkpoints, Resume};
use crate::{domain::JobId, store::Store};

/// The checkpoints of a job below `root`: kept in a folder of its own, and gone on from if an earlier attempt left one.
pub(super) fn of_job(root: Option<&Path>, job: JobId) -> Checkpoints {
    let folder = root.map(|root| root.join(job.to_string()));
    let resume = folder.clone().map_or(Resume::Fresh, Resume::IfPossible);
    Checkpoints { keep: folder, resume }
}

/// Removes the folders below `root` whose jobs have ended or are unknown.
pub(super) async fn sweep(root: &Path, store: &dyn Store) {
    for (job, folder) in folders(root) {
        let over = match store.job(job).await {
            Ok(record) => record.is_none_or(|record| record.job.state.is_terminal()),
            // Kept for now: whether the job needs it is not known.
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, "checkpoints stay: {error}");
                false
            }
        };
        if !over {
            continue;
        }
        match fs::remove_dir_all(&folder) {
            Ok(()) => {}
            // Another worker may be sweeping too.
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => {}
            Err(fault) => tracing::warn!("{} stays: {fault}", folder.display()),
        }
    }
}

/// The folders below `root` that are named by jobs.
fn folders(root: &Path) -> Vec<(JobId, PathBuf)> {
    let Ok(entries) = fs::read_dir(root) else { return Vec::new() };
    entries
        .flatten()
        .filter_map(|entry| Some((entry.file_name().to_str()?.parse().ok()?, entry.path())))
        .collect()
}
