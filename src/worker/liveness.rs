//! Detects dead workers by lock files.
//!
//! Each supervised worker locks a file with its name while its process lives. So a service that starts after a power cut knows at once
//! which workers died with the service before, and their jobs need not wait until leases expire. These deaths do not count against
//! the jobs.

use std::{
    fs::{self, File, TryLockError},
    io,
    path::{Path, PathBuf},
};

use crate::store::{Store, WorkerDeath};

/// A worker's lock file; removed with this value, and unlocked at the end of the process.
#[derive(Debug)]
pub(super) struct LivenessLock {
    path: PathBuf,
    _locked: File,
}

impl LivenessLock {
    /// Locks the file of worker `id`.
    pub(super) fn acquire(folder: &Path, id: &str) -> io::Result<Self> {
        fs::create_dir_all(folder)?;
        let path = folder.join(id);
        let locked = File::create_new(&path)?;
        locked.lock()?;
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

/// Ends the attempts of dead workers. On errors the next call tries again; in the end the leases expire.
pub(super) async fn expire_dead_workers(folder: &Path, store: &dyn Store) {
    let dead = match dead(folder) {
        Ok(dead) => dead,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return,
        Err(error) => {
            tracing::warn!("dead workers cannot be looked up in {}: {error}", folder.display());
            return;
        }
    };
    for (id, path) in dead {
        if expire_worker(store, &id, WorkerDeath::WithService).await
            && let Err(error) = fs::remove_file(&path)
        {
            tracing::debug!("{} cannot be removed: {error}", path.display());
        }
    }
}

/// Ends the attempts of a dead worker, which need not wait for its leases to expire; returns whether that succeeded.
pub(super) async fn expire_worker(store: &dyn Store, id: &str, death: WorkerDeath) -> bool {
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

/// Names and files of workers whose process has ended.
fn dead(folder: &Path) -> io::Result<Vec<(String, PathBuf)>> {
    let mut dead = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let Ok(id) = entry.file_name().into_string() else { continue };
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

#[cfg(test)]
mod tests {
    use super::*;

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
