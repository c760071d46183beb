//! The checkpoint folders of jobs, and their removal: when the job has succeeded or is deleted, and some time after it failed or was
//! cancelled.
//!
//! Each attempt writes to a folder of its own, which the next attempt renames to its own. So an attempt that has lost its lease without
//! noticing writes where nobody reads.

use std::{
    collections::BTreeSet,
    fs, io,
    path::{Path, PathBuf},
};

use crate::{
    domain::JobId,
    pipeline::{CheckpointPlan, Resume},
    store::{Lease, Store},
};

/// Prefix of an attempt's folder name, before its number.
const ATTEMPT: &str = "attempt-";

/// Prefix of the name of a folder of an attempt's search for cameras, before its number.
const SEARCH: &str = "poses-";

/// The folder of a job's checkpoints.
pub(super) fn folder(root: &Path, job: JobId) -> PathBuf {
    root.join(job.to_string())
}

/// The checkpoint folder of an attempt below `root`, with the checkpoint of the job's attempt before, or else that of the job
/// `resume_from`.
pub(super) fn of_attempt(root: Option<&Path>, lease: &Lease, resume_from: Option<JobId>) -> CheckpointPlan {
    let Some(root) = root else { return CheckpointPlan { keep: None, resume: Resume::Fresh } };
    let job = folder(root, lease.job);
    let own = job.join(attempt_name(lease.attempt));
    if let Some(earlier) = newest(&job, lease.attempt) {
        take_over(&earlier, &own, lease.job);
    } else if let Some(resume_from) = resume_from {
        let retried = folder(root, resume_from);
        // Moved rather than copied: that job does not run, and of two retries only one can resume.
        if let Some(earlier) = newest(&retried, u32::MAX)
            && take_over(&earlier, &own, lease.job)
        {
            tracing::info!("job {} resumes from the checkpoint of job {resume_from}", lease.job);
            remove(&retried);
        }
    }
    CheckpointPlan { keep: Some(own.clone()), resume: Resume::IfPossible(own) }
}

/// The folder of an attempt's search for cameras below `root`, with what the search of the attempt before left, or else that of the job
/// `resume_from`.
pub(super) fn search_of_attempt(root: &Path, lease: &Lease, resume_from: Option<JobId>) -> PathBuf {
    let job = folder(root, lease.job);
    let own = job.join(format!("{SEARCH}{}", lease.attempt));
    let of_retried = || numbered(&folder(root, resume_from?), SEARCH, u32::MAX);
    if let Some(earlier) = numbered(&job, SEARCH, lease.attempt).or_else(of_retried)
        && take_over(&earlier, &own, lease.job)
    {
        tracing::info!("job {} resumes the search for cameras", lease.job);
    }
    own
}

/// Moves the checkpoints of an attempt to the next one's folder; returns whether that succeeded.
fn take_over(earlier: &Path, own: &Path, job: JobId) -> bool {
    let moved = own.parent().map_or(Ok(()), fs::create_dir_all).and_then(|()| fs::rename(earlier, own));
    match moved {
        Ok(()) => true,
        Err(error) if error.kind() == io::ErrorKind::NotFound => false,
        Err(error) => {
            tracing::warn!(%job, "job {job} cannot resume from {}: {error}", earlier.display());
            false
        }
    }
}

/// The name of an attempt's folder.
pub(super) fn attempt_name(attempt: u32) -> String {
    format!("{ATTEMPT}{attempt}")
}

/// The attempt whose folder has this name.
pub(super) fn attempt_number(name: &str) -> Option<u32> {
    name.strip_prefix(ATTEMPT)?.parse().ok()
}

/// The newest attempt of a job before `attempt` that has a folder.
pub(super) fn newest_attempt(root: &Path, job: JobId, attempt: u32) -> Option<u32> {
    attempt_number(newest(&folder(root, job), attempt)?.file_name()?.to_str()?)
}

/// The folder of the newest attempt before `attempt` in the folder of a job.
fn newest(job: &Path, attempt: u32) -> Option<PathBuf> {
    numbered(job, ATTEMPT, attempt)
}

/// The folder with the largest number below `attempt` after `prefix`.
fn numbered(job: &Path, prefix: &str, attempt: u32) -> Option<PathBuf> {
    let number = |path: &Path| path.file_name()?.to_str()?.strip_prefix(prefix)?.parse::<u32>().ok();
    let folders = fs::read_dir(job).ok()?.flatten().map(|entry| entry.path());
    let numbered = folders.filter_map(|path| Some((number(&path)?, path)));
    numbered.filter(|(number, _)| *number < attempt).max().map(|(_, path)| path)
}

/// Removes the checkpoints of a deleted job below `root`.
pub(super) fn forget(root: &Path, job: JobId) {
    remove(&folder(root, job));
}

/// Removes the folders below `root` that no job can resume from any more.
pub(super) async fn sweep(root: &Path, store: &Store) {
    let folders = folders(root);
    if folders.is_empty() {
        return;
    }
    let jobs: Vec<JobId> = folders.iter().map(|(job, _)| *job).collect();
    let wanted: BTreeSet<JobId> = match store.resumable(&jobs).await {
        Ok(wanted) => wanted.into_iter().collect(),
        // Kept, since the jobs may need them.
        Err(error) => {
            tracing::warn!(
                error = &error as &dyn std::error::Error,
                "unneeded checkpoints cannot be determined: {error}"
            );
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
        // There may have been none, or another worker has removed it.
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => tracing::warn!("{} cannot be removed: {error}", folder.display()),
    }
}

/// The folders of jobs below `root`.
fn folders(root: &Path) -> Vec<(JobId, PathBuf)> {
    let Ok(entries) = fs::read_dir(root) else { return Vec::new() };
    entries
        .flatten()
        .filter_map(|entry| Some((entry.file_name().to_str()?.parse().ok()?, entry.path())))
        .collect()
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    fn lease(job: u128, attempt: u32) -> Lease {
        Lease { job: JobId(Uuid::from_u128(job)), attempt, worker: "w".into() }
    }

    /// The folder that an attempt writes to and resumes from.
    fn begin(root: &Path, lease: &Lease, resume_from: Option<JobId>) -> PathBuf {
        let CheckpointPlan { keep, resume } = of_attempt(Some(root), lease, resume_from);
        let keep = keep.expect("a folder");
        assert_eq!(resume, Resume::IfPossible(keep.clone()));
        keep
    }

    fn write(folder: &Path, content: &str) {
        fs::create_dir_all(folder).expect("made");
        fs::write(folder.join("checkpoint"), content).expect("written");
    }

    fn read(folder: &Path) -> String {
        fs::read_to_string(folder.join("checkpoint")).expect("there")
    }

    #[test]
    fn an_attempt_that_lost_its_lease_writes_where_nobody_reads() {
        let root = tempfile::tempdir().expect("a folder");
        let stale = begin(root.path(), &lease(1, 1), None);
        write(&stale, "step 100");
        let live = begin(root.path(), &lease(1, 2), None);
        assert_eq!(read(&live), "step 100", "the next attempt resumes from it");
        assert!(!stale.exists());
        write(&live, "step 300");
        write(&stale, "step 200");
        assert_eq!(read(&live), "step 300", "and is not overwritten by it");
        let next = begin(root.path(), &lease(1, 4), None);
        assert_eq!(read(&next), "step 300", "also after an attempt that never started");
    }

    #[test]
    fn a_retry_takes_the_checkpoint_of_the_retried_job_unless_it_has_its_own() {
        let root = tempfile::tempdir().expect("a folder");
        let other = Some(lease(1, 1).job);
        write(&begin(root.path(), &lease(1, 3), None), "another's");
        let own = begin(root.path(), &lease(2, 1), other);
        assert_eq!(read(&own), "another's");
        assert!(!folder(root.path(), lease(1, 1).job).exists());
        write(&begin(root.path(), &lease(1, 4), None), "later");
        assert_eq!(read(&begin(root.path(), &lease(2, 2), other)), "another's", "its own checkpoint");
        forget(root.path(), lease(2, 1).job);
        assert!(!folder(root.path(), lease(2, 1).job).exists());
        assert_eq!(of_attempt(None, &lease(1, 1), other), CheckpointPlan::default());
    }
}
