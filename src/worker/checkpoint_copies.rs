//! Copies of checkpoints in a bucket, so that a job is resumed on another machine.
//!
//! Each attempt copies its folder to names of its own, so an attempt that has lost its lease without noticing writes where nobody reads. A
//! file is copied whenever it has changed; those of a folder are independent of each other. So a job is resumed from the newest copy of each
//! file, also if its latest attempt ended before it had copied them all; once one has, the copies of the attempts before it are removed.

use std::{
    cmp::Reverse,
    collections::BTreeMap,
    error::Error,
    fs, io,
    path::{Path, PathBuf},
    time::{Duration, SystemTime},
};

use tokio::{task::JoinHandle, time::sleep};
use tokio_util::sync::CancellationToken;

use super::checkpoints;
use crate::{
    domain::JobId,
    store::{BlobError, Lease, SharedFiles, Store},
};

/// Folder of the copies.
const ROOT: &str = "checkpoints";

/// The folder with the copies of a job's checkpoints.
fn of_job(job: JobId) -> String {
    format!("{ROOT}/{job}")
}

/// Copies the folder of an attempt for as long as it runs.
pub(super) struct CheckpointCopies {
    stop: CancellationToken,
    copying: JoinHandle<Copier>,
}

struct Copier {
    files: SharedFiles,
    /// Folder of the attempt.
    folder: PathBuf,
    /// The attempt, whose name the copies have in the bucket.
    lease: Lease,
    /// What has been copied, as it was then.
    copied: BTreeMap<PathBuf, (SystemTime, u64)>,
    /// Whether the copies of the attempts before have been removed.
    is_only: bool,
}

impl CheckpointCopies {
    /// Copies `folder`, that of the attempt `lease`, every so often from now on.
    pub(super) fn start(files: SharedFiles, folder: PathBuf, lease: &Lease, every: Duration) -> Self {
        let lease = lease.clone();
        let mut copier = Copier { files, folder, lease, copied: BTreeMap::new(), is_only: false };
        let stop = CancellationToken::new();
        let stopped = stop.clone();
        let copying = tokio::spawn(async move {
            loop {
                tokio::select! {
                    () = stopped.cancelled() => return copier,
                    () = sleep(every) => copier.copy().await,
                }
            }
        });
        Self { stop, copying }
    }

    /// Stops, without a last copy.
    pub(super) fn abandon(self) {
        self.copying.abort();
    }

    /// Stops after a last copy.
    pub(super) async fn finish(self) {
        self.stop.cancel();
        if let Ok(mut copier) = self.copying.await {
            copier.copy().await;
        }
    }
}

impl Copier {
    /// Copies what has changed. A failure costs at most the steps since the copy before.
    async fn copy(&mut self) {
        let name = of_attempt(self.lease.job, self.lease.attempt);
        let mut is_complete = true;
        let listed = files_below(&self.folder, &mut |folder, error| {
            is_complete = false;
            // A file that is replaced while the folder is listed is found next time.
            if error.kind() != io::ErrorKind::NotFound {
                let error = &error as &dyn Error;
                tracing::warn!(error, "checkpoints in {} cannot be listed: {error}", folder.display());
            }
        });
        for (path, version) in listed {
            if self.copied.get(&path) == Some(&version) {
                continue;
            }
            let Some(relative) = path.strip_prefix(&self.folder).ok().and_then(Path::to_str) else {
                is_complete = false;
                continue;
            };
            match self.files.save(&format!("{name}/{relative}"), &path).await {
                Ok(()) => drop(self.copied.insert(path, version)),
                // Replaced meanwhile by one that is copied next time.
                Err(BlobError::Io(error)) if error.kind() == io::ErrorKind::NotFound => is_complete = false,
                Err(error) => {
                    is_complete = false;
                    tracing::warn!(error = &error as &dyn Error, "a checkpoint is not copied: {error}");
                }
            }
        }
        if is_complete && !self.copied.is_empty() && !self.is_only {
            self.remove_earlier().await;
        }
    }

    /// Removes the copies of the attempts before, which nobody needs once all files have been copied.
    async fn remove_earlier(&mut self) {
        let Lease { job, attempt, .. } = self.lease;
        let removed = async {
            for earlier in attempts_before(&self.files, job, attempt).await? {
                self.files.remove_below(&of_attempt(job, earlier)).await?;
            }
            Ok::<(), BlobError>(())
        };
        match removed.await {
            Ok(()) => self.is_only = true,
            Err(error) => {
                tracing::warn!(error = &error as &dyn Error, "earlier checkpoints are not removed: {error}");
            }
        }
    }
}

/// The folder with the copies of an attempt's checkpoints.
fn of_attempt(job: JobId, attempt: u32) -> String {
    format!("{}/{}", of_job(job), checkpoints::attempt_name(attempt))
}

/// The attempts of a job before `before` that have copies, the newest first.
async fn attempts_before(files: &SharedFiles, job: JobId, before: u32) -> Result<Vec<u32>, BlobError> {
    let folders = files.folders(&of_job(job)).await?;
    let attempts = folders.iter().filter_map(|name| checkpoints::attempt_number(name));
    let mut attempts: Vec<u32> = attempts.filter(|attempt| *attempt < before).collect();
    attempts.sort_by_key(|attempt| Reverse(*attempt));
    Ok(attempts)
}

/// The checkpoint files below a folder, with the time of their last change and their length. Names that begin with a dot are files that
/// are being written. `failed` gets each entry that cannot be read, with the folder that it is in.
fn files_below(folder: &Path, failed: &mut dyn FnMut(&Path, io::Error)) -> Vec<(PathBuf, (SystemTime, u64))> {
    let mut found = Vec::new();
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) => {
            failed(folder, error);
            return found;
        }
    };
    for entry in entries {
        let known = entry.and_then(|entry| {
            let metadata = entry.metadata()?;
            let modified = metadata.modified()?;
            Ok((entry, metadata, modified))
        });
        match known {
            Ok((entry, metadata, _)) if metadata.is_dir() => found.extend(files_below(&entry.path(), failed)),
            Ok((entry, ..)) if entry.file_name().as_encoded_bytes().starts_with(b".") => {}
            Ok((entry, metadata, modified)) => found.push((entry.path(), (modified, metadata.len()))),
            Err(error) => failed(folder, error),
        }
    }
    found
}

/// Removes a folder and what is in it, if it is there.
fn remove_folder(folder: &Path) -> io::Result<()> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// Brings what an attempt resumes from below `root`, unless it is there already: the newest checkpoint of its job, or else of the job that
/// it retries. Without a checkpoint that can be read the job begins again.
///
/// # Errors
/// If the bucket is away or the disk is full: a later attempt may find the checkpoint.
pub(super) async fn fetch(
    files: &SharedFiles,
    root: &Path,
    lease: &Lease,
    resume_from: Option<JobId>,
) -> Result<(), BlobError> {
    let found = async {
        if !fetch_job(files, root, lease.job, lease.attempt).await?
            && let Some(retried) = resume_from
        {
            fetch_job(files, root, retried, u32::MAX).await?;
        }
        Ok::<(), BlobError>(())
    };
    match found.await {
        Err(error) if error.is_transient() || error.is_disk_full() => Err(error),
        Err(error) => {
            tracing::warn!(
                error = &error as &dyn Error,
                "job {} begins again, since its checkpoint cannot be read: {error}",
                lease.job
            );
            Ok(())
        }
        Ok(()) => Ok(()),
    }
}

/// Brings a job's newest checkpoint of the attempts before `before`, and returns whether it has one.
async fn fetch_job(files: &SharedFiles, root: &Path, job: JobId, before: u32) -> Result<bool, BlobError> {
    let attempts = attempts_before(files, job, before).await?;
    let here = checkpoints::newest_attempt(root, job, before);
    let newest = attempts.first().copied().filter(|newest| here.is_none_or(|here| here < *newest));
    let Some(newest) = newest else {
        return Ok(here.is_some());
    };
    let folder = checkpoints::folder(root, job);
    // Complete before it has its name, so that no half of it is resumed from.
    let partial = folder.join(format!("fetched-{newest}"));
    // Files of an interrupted fetch may be older than those of the bucket.
    remove_folder(&partial)?;
    for attempt in attempts {
        let name = of_attempt(job, attempt);
        for file in files.below(&name).await? {
            let Some(relative) = file.strip_prefix(&name) else { continue };
            let to = partial.join(relative.trim_start_matches('/'));
            if !to.exists() {
                files.load(&file, &to).await?;
            }
        }
    }
    fs::rename(&partial, folder.join(checkpoints::attempt_name(newest)))?;
    tracing::info!("job {job} goes on with a checkpoint of another machine, of attempt {newest}");
    Ok(true)
}

/// Removes the copies that no job can resume from any more.
pub(super) async fn sweep(files: &SharedFiles, store: &Store) {
    let swept = async {
        let jobs: Vec<JobId> =
            files.folders(ROOT).await?.iter().filter_map(|name| name.parse().ok()).collect();
        if jobs.is_empty() {
            return Ok(());
        }
        let wanted = store.resumable(&jobs).await?;
        for job in jobs.iter().filter(|job| !wanted.contains(job)) {
            files.remove_below(&of_job(*job)).await?;
        }
        Ok::<(), BlobError>(())
    };
    if let Err(error) = swept.await {
        tracing::warn!(error = &error as &dyn Error, "unneeded checkpoints are not removed: {error}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_that_cannot_be_read_are_told_and_hidden_files_are_not() {
        let root = tempfile::tempdir().expect("a folder");
        fs::create_dir(root.path().join("branch-0")).expect("made");
        for name in ["step", ".step", "branch-0/step"] {
            fs::write(root.path().join(name), "400").expect("written");
        }
        let mut failures = Vec::new();
        let found =
            files_below(root.path(), &mut |folder, error| failures.push((folder.to_owned(), error.kind())));
        assert_eq!((found.len(), failures.len()), (2, 0));
        // A file in the place of a folder, and a folder that is gone, cannot be listed by anybody.
        for (name, kind) in [("step", io::ErrorKind::NotADirectory), ("gone", io::ErrorKind::NotFound)] {
            let folder = root.path().join(name);
            let found =
                files_below(&folder, &mut |folder, error| failures.push((folder.to_owned(), error.kind())));
            assert_eq!((found.len(), failures.pop()), (0, Some((folder, kind))));
        }
    }

    #[test]
    fn a_folder_that_is_not_there_is_removed_and_one_that_stays_is_an_error() {
        let root = tempfile::tempdir().expect("a folder");
        let folder = root.path().join("fetched-1");
        fs::create_dir(&folder).expect("made");
        fs::write(folder.join("step"), "100").expect("written");
        remove_folder(&folder).expect("removed");
        remove_folder(&folder).expect("not there");
        fs::write(&folder, "a file").expect("written");
        remove_folder(&folder).expect_err("not a folder");
        assert!(folder.exists());
    }
}
