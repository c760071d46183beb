//! Detects dead workers by lock files.
//!
//! Each supervised worker locks a file with its name while its process lives. So a service that starts after a power cut knows at once
//! which workers died with the service before, and their jobs need not wait until leases expire. These deaths do not count against
//! the jobs.

use std::{
    fs::{self, File, TryLockError},
    io,
    path::{Path, PathBuf},
    time::Duration,
};

use crate::store::{Store, WorkerDeath};

/// What the name of a file begins with that is not locked yet.
const HIDDEN: &str = ".";

/// How long a file may take to be locked. One that is older was left by a worker that was killed meanwhile.
const LOCKED_WITHIN: Duration = Duration::from_secs(60);

/// A worker's lock file; removed with this value, and unlocked at the end of the process.
#[derive(Debug)]
pub(super) struct LivenessLock {
    path: PathBuf,
    _locked: File,
}

impl LivenessLock {
    /// Locks the file of worker `id`. It has its name once it is locked: an unlocked one is that of a dead worker.
    pub(super) fn acquire(folder: &Path, id: &str) -> io::Result<Self> {
        fs::create_dir_all(folder)?;
        let (path, hidden) = (folder.join(id), folder.join(format!("{HIDDEN}{id}")));
        if path.exists() {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        let locked = File::create_new(&hidden)?;
        locked.lock()?;
        fs::rename(&hidden, &path)?;
        Ok(Self { path, _locked: locked })
    }
}

impl Drop for LivenessLock {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_file(&self.path) {
            tracing::debug!("{} cannot be removed: {error}", self.path.display());
        }
    }
}

/// Ends the attempts of those dead workers that `is_wanted` names. On errors the next call tries again; in the end the leases expire.
pub(super) async fn expire_dead_workers(
    folder: &Path,
    store: &Store,
    is_wanted: &(dyn Fn(&str) -> bool + Sync),
) {
    let dead = match dead(folder) {
        Ok(dead) => dead,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return,
        Err(error) => {
            tracing::warn!("dead workers cannot be looked up in {}: {error}", folder.display());
            return;
        }
    };
    for (id, path) in dead.into_iter().filter(|(id, _)| is_wanted(id)) {
        if expire_worker(store, &id, WorkerDeath::WithService).await
            && let Err(error) = fs::remove_file(&path)
        {
            tracing::debug!("{} cannot be removed: {error}", path.display());
        }
    }
}

/// Ends the attempts of a dead worker, which need not wait for its leases to expire; returns whether that succeeded.
pub(super) async fn expire_worker(store: &Store, id: &str, death: WorkerDeath) -> bool {
    match store.expire_worker(id, death).await {
        Ok(0) => {}
        Ok(jobs) => tracing::warn!(worker = id, jobs, "ended {jobs} attempts of the dead worker {id}"),
        Err(error) => {
            let cause = &error as &dyn std::error::Error;
            tracing::error!(worker = id, error = cause, "the leases of {id} will have to expire: {error}");
            return false;
        }
    }
    true
}

/// Removes the file of a worker that has ended, if it has left one.
pub(super) fn remove(folder: &Path, id: &str) {
    match fs::remove_file(folder.join(id)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            tracing::debug!("the lock file of {id} cannot be removed: {error}");
        }
        _ => {}
    }
}

/// Names and files of workers whose process has ended.
fn dead(folder: &Path) -> io::Result<Vec<(String, PathBuf)>> {
    let mut dead = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let Ok(id) = entry.file_name().into_string() else { continue };
        if id.starts_with(HIDDEN) {
            remove_abandoned(&entry.path());
            continue;
        }
        match File::options().write(true).open(entry.path()).map(|file| file.try_lock()) {
            Ok(Ok(())) => dead.push((id, entry.path())),
            Ok(Err(TryLockError::WouldBlock)) => {}
            // It has just exited normally.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Ok(Err(TryLockError::Error(error))) | Err(error) => return Err(error),
        }
    }
    Ok(dead)
}

/// Removes a file that was never locked, once it is old.
fn remove_abandoned(path: &Path) {
    let age = fs::metadata(path).and_then(|file| file.modified()).ok().and_then(|at| at.elapsed().ok());
    if age.is_some_and(|age| age > LOCKED_WITHIN)
        && let Err(error) = fs::remove_file(path)
    {
        tracing::debug!("{} cannot be removed: {error}", path.display());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_is_not_locked_yet_is_no_dead_worker_and_goes_once_it_is_old() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join(".starting");
        let file = File::create(&path).expect("made");
        assert!(dead(folder.path()).expect("listed").is_empty() && path.exists());
        let made = file.metadata().and_then(|metadata| metadata.modified()).expect("a time");
        file.set_modified(made - 2 * LOCKED_WITHIN).expect("set");
        assert!(dead(folder.path()).expect("listed").is_empty() && !path.exists());
    }

    #[test]
    fn a_worker_is_dead_once_its_file_is_unlocked() {
        let folder = tempfile::tempdir().expect("a folder");
        let workers = folder.path().join("workers");
        assert!(dead(&workers).is_err_and(|error| error.kind() == io::ErrorKind::NotFound));
        let [ended, alive] =
            ["ended", "alive"].map(|id| LivenessLock::acquire(&workers, id).expect("locked"));
        fs::write(workers.join("killed"), "").expect("left behind");
        let names = || dead(&workers).expect("listed").into_iter().map(|(id, _)| id).collect::<Vec<_>>();
        assert_eq!(names(), ["killed"]);
        drop(ended);
        assert_eq!(names(), ["killed"], "a worker that exits normally leaves no file");
        assert!(LivenessLock::acquire(&workers, "alive").is_err(), "no two workers share a name");
        drop(alive);
    }
}
