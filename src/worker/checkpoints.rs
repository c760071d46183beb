//! Where the checkpoints of jobs are, and their removal once nobody can need them: when the job has succeeded or is deleted, and
//! some time after it failed or was cancelled.

use std::{
    collections::BTreeSet,
    fs, io,
    path::{Path, PathBuf},
};

use super::run::{Checkpoints, Resume};
use crate::{domain::JobId, store::Store};

fn folder(root: &Path, job: JobId) -> PathBuf {
    root.join(job.to_string())
}

/// The checkpoints of a job below `root`: kept in a folder of its own, and gone on from if an earlier attempt left one, or else
/// the job that this one `adopts`.
pub(super) fn of_job(root: Option<&Path>, job: JobId, adopts: Option<JobId>) -> Checkpoints {
    let Some(root) = root else { return Checkpoints { keep: None, resume: Resume::Fresh } };
    let own = folder(root, job);
    if let Some(adopts) = adopts
        && !own.exists()
    {
        // Moved rather than copied: nobody else runs it, and of two jobs that repeat it one is enough to go on.
        match fs::rename(folder(root, adopts), &own) {
            Ok(()) => tracing::info!(%job, "job {job} goes on from where job {adopts} stopped"),
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => {}
            Err(fault) => tracing::warn!(%job, "job {job} cannot go on from job {adopts}: {fault}"),
        }
    }
    Checkpoints { keep: Some(own.clone()), resume: Resume::IfPossible(own) }
}

/// Removes what is kept below `root` of a job that is deleted.
pub fn forget(root: &Path, job: JobId) {
    remove(&folder(root, job));
}

/// Removes the folders below `root` that nobody can go on from any more.
pub(super) async fn sweep(root: &Path, store: &dyn Store) {
    let folders = folders(root);
    if folders.is_empty() {
        return;
    }
    let jobs: Vec<JobId> = folders.iter().map(|(job, _)| *job).collect();
    let wanted: BTreeSet<JobId> = match store.resumable(&jobs).await {
        Ok(wanted) => wanted.into_iter().collect(),
        // Kept for now: whether the jobs need them is not known.
        Err(error) => {
            tracing::warn!(error = &error as &dyn std::error::Error, "checkpoints stay: {error}");
            return;
        }
    };
    for (_, folder) in folders.iter().filter(|(job, _)| !wanted.contains(job)) {
        remove(folder);
    }
}

fn remove(folder: &Path) {
    match fs::remove_dir_all(folder) {
        Ok(()) => {}
        // There may have been none, and another worker may be sweeping too.
        Err(fault) if fault.kind() == io::ErrorKind::NotFound => {}
        Err(fault) => tracing::warn!("{} stays: {fault}", folder.display()),
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
