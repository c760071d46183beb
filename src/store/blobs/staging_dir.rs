//! The folder where one process stages blobs, and the removal of those of dead processes.
//!
//! Each process that opens the store has a folder of its own in `staging`, with a lock that the system releases when the process ends,
//! in whatever way. Creating such a folder and searching for unlocked ones exclude each other, so that none is removed before it is
//! locked.

use std::{
    fs::{self, File, TryLockError},
    io,
    path::Path,
};

use tempfile::TempDir;

use super::{
    BlobError, Blobs, blocking,
    files::{entries, open_lock},
};

/// Name of the lock file in a process's folder.
const LOCK_FILE: &str = "held";

/// A process's own folder; dropping this removes it.
#[derive(Debug)]
pub(super) struct StagingDir {
    // Closed first: some systems cannot remove open files.
    _lock: File,
    folder: TempDir,
}

impl StagingDir {
    /// Creates one in `staging`, and removes those of dead processes. `lock` is the store's lock file.
    pub(super) fn open(staging: &Path, lock: &Path) -> io::Result<Self> {
        let guard = open_lock(lock)?;
        guard.lock()?;
        sweep(staging)?;
        let folder = tempfile::Builder::new().prefix("process-").tempdir_in(staging)?;
        let lock = File::create_new(folder.path().join(LOCK_FILE))?;
        lock.lock()?;
        Ok(Self { _lock: lock, folder })
    }

    pub(super) fn path(&self) -> &Path {
        self.folder.path()
    }
}

impl Blobs {
    /// Removes staging folders of dead processes.
    pub async fn clear_staging(&self) -> Result<(), BlobError> {
        let (staging, lock) = (self.0.staging.clone(), self.0.lock.clone());
        blocking(move || {
            let guard = open_lock(&lock)?;
            guard.lock()?;
            sweep(&staging)
        })
        .await
    }
}

fn sweep(staging: &Path) -> io::Result<()> {
    sweep_by(staging, |path| if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) })
}

fn sweep_by(staging: &Path, remove: impl Fn(&Path) -> io::Result<()>) -> io::Result<()> {
    for path in entries(staging)? {
        if is_held(&path) {
            continue;
        }
        match remove(&path) {
            Ok(()) => tracing::info!(path = %path.display(), "removed a staging folder of a dead process"),
            // Its own process may have removed it.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            // Garbage must not prevent the start.
            Err(error) => {
                tracing::warn!(path = %path.display(), "a staging folder of a dead process cannot be removed: {error}")
            }
        }
    }
    Ok(())
}

/// Whether a live process has locked the folder; true if that cannot be determined.
fn is_held(folder: &Path) -> bool {
    let opened = File::options().write(true).open(folder.join(LOCK_FILE));
    match opened.map(|file| file.try_lock()) {
        Ok(Ok(())) => false,
        Ok(Err(TryLockError::WouldBlock)) => true,
        // Not a folder, or its process ended before locking it.
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => false,
        Ok(Err(TryLockError::Error(error))) | Err(error) => {
            tracing::warn!(path = %folder.display(), "cannot determine whether a process uses this staging folder: {error}");
            true
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn folders_of_dead_processes_are_removed_and_those_of_live_ones_stay() {
        let folder = tempfile::tempdir().expect("a folder");
        let living = Blobs::open(folder.path()).expect("opens");
        let mut staging = living.stage(100).await.expect("room");
        staging.write(b"half").await.expect("written");
        let dead = folder.path().join("staging/process-dead");
        let leave = || {
            fs::create_dir_all(&dead).expect("made");
            fs::write(dead.join(LOCK_FILE), "").expect("made");
            fs::write(dead.join("upload-half"), b"half").expect("written");
        };
        leave();
        let other = Blobs::open(folder.path()).expect("opens again");
        assert!(!dead.exists(), "at the next opening");
        leave();
        living.clear_staging().await.expect("swept");
        assert!(!dead.exists(), "and by garbage collection");

        let staged = staging.finish().await.expect("whole");
        assert!(staged.path().exists());
        let folders = || fs::read_dir(folder.path().join("staging")).expect("a folder").count();
        assert_eq!(folders(), 2);
        drop(other);
        assert_eq!(folders(), 1, "dropping the store removes its folder");
    }

    #[test]
    fn a_folder_that_cannot_be_removed_prevents_neither_the_start_nor_other_removals() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["a", "b", "c"] {
            fs::create_dir(folder.path().join(name)).expect("made");
        }
        // Tests may run as root, whom the system refuses nothing, so the errors are made up.
        let swept = sweep_by(folder.path(), |path| match path.file_name().and_then(|name| name.to_str()) {
            Some("a") => Err(io::ErrorKind::PermissionDenied.into()),
            Some("b") => Err(io::ErrorKind::NotFound.into()),
            _ => fs::remove_dir_all(path),
        });
        swept.expect("no error");
        let left = |name: &str| folder.path().join(name).exists();
        assert_eq!(["a", "b", "c"].map(left), [true, true, false]);
    }
}
