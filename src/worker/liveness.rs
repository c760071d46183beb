//! Which supervised workers are alive, as the system knows it.
//!
//! Each holds a file of its name locked while its process lives, however it ends. So a service that starts after a power cut knows
//! at once which workers ended with the service before it, and their jobs need not wait until leases run out. Since nobody saw
//! them die, nothing is held against their jobs.

use std::{
    fs::{self, File, TryLockError},
    io,
    path::{Path, PathBuf},
};

use crate::store::{Store, WorkerDeath};

/// A worker's sign of life; it goes with this value, or with the process.
#[derive(Debug)]
pub(super) struct LivenessLock {
    path: PathBuf,
    /// Let go by the system.
    _held: File,
}

impl LivenessLock {
    /// Shows that the worker `id` is alive.
    pub(super) fn announce(folder: &Path, id: &str) -> io::Result<Self> {
        fs::create_dir_all(folder)?;
        let path = folder.join(id);
        let held = File::create_new(&path)?;
        held.lock()?;
        Ok(Self { path, _held: held })
    }
}

impl Drop for LivenessLock {
    fn drop(&mut self) {
        if let Err(fault) = fs::remove_file(&self.path) {
            tracing::debug!("{} stays: {fault}", self.path.display());
        }
    }
}

/// Takes their jobs from workers that have died in silence. What cannot be looked at or written now is left to the next call,
/// and at last to the leases.
pub(super) async fn expire_dead_workers(folder: &Path, store: &dyn Store) {
    let dead = match dead(folder) {
        Ok(dead) => dead,
        Err(fault) if fault.kind() == io::ErrorKind::NotFound => return,
        Err(fault) => {
            tracing::warn!("cannot tell which workers of {} are dead: {fault}", folder.display());
            return;
        }
    };
    for (id, path) in dead {
        match store.expire_worker(&id, WorkerDeath::WithService).await {
            Ok(jobs) => {
                if jobs > 0 {
                    tracing::warn!(worker = id, jobs, "took {jobs} jobs from {id}, which ended unseen");
                }
                if let Err(fault) = fs::remove_file(&path) {
                    tracing::debug!("{} stays: {fault}", path.display());
                }
            }
            Err(error) => {
                let error = &error as &dyn std::error::Error;
                tracing::error!(error, worker = id, "the leases of {id} must run out: {error}");
            }
        }
    }
}

/// Names and files of workers whose process is gone.
fn dead(folder: &Path) -> io::Result<Vec<(String, PathBuf)>> {
    let mut dead = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let Ok(id) = entry.file_name().into_string() else { continue };
        match File::options().write(true).open(entry.path()).map(|file| file.try_lock()) {
            Ok(Ok(())) => dead.push((id, entry.path())),
            Ok(Err(TryLockError::WouldBlock)) => {}
            // It ended in order a moment ago.
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => {}
            Ok(Err(TryLockError::Error(fault))) | Err(fault) => return Err(fault),
        }
    }
    Ok(dead)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_worker_is_dead_once_nobody_holds_its_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let workers = folder.path().join("workers");
        assert!(dead(&workers).is_err_and(|fault| fault.kind() == io::ErrorKind::NotFound));
        let [ended, alive] =
            ["ended", "alive"].map(|id| LivenessLock::announce(&workers, id).expect("announced"));
        fs::write(workers.join("killed"), "").expect("left behind");
        let names = || dead(&workers).expect("told").into_iter().map(|(id, _)| id).collect::<Vec<_>>();
        assert_eq!(names(), ["killed"]);
        drop(ended);
        assert_eq!(names(), ["killed"], "who ends in order leaves nothing");
        assert!(LivenessLock::announce(&workers, "alive").is_err(), "no two workers share a name");
        drop(alive);
    }
}
