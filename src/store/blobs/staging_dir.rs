//! The folder where one process stages blobs, and the end of those whose process is gone.
//!
//! Each process that opens the store has a folder of its own in `staging`, with a lock that the system lets go when the process
//! ends, however it ends. Making such a folder and looking for those that nobody holds exclude each other, so that none is
//! taken for litter before it is held.

use std::{
    fs::{self, File, TryLockError},
    io,
    path::Path,
};

use tempfile::TempDir;

use super::{
    BlobError, Blobs,
    age::{entries, open_lock},
    blocking,
};

/// Name of the file in a process's folder that it holds locked.
const HELD: &str = "held";

/// A process's own folder; it goes with this value.
#[derive(Debug)]
pub(super) struct StagingDir {
    // Let go first: some systems remove no file that is open.
    _held: File,
    folder: TempDir,
}

impl StagingDir {
    /// A new one in `staging`; what processes that are gone have left there is removed. `lock` is the store's.
    pub(super) fn open(staging: &Path, lock: &Path) -> io::Result<Self> {
        let guard = open_lock(lock)?;
        guard.lock()?;
        sweep(staging)?;
        let folder = tempfile::Builder::new().prefix("process-").tempdir_in(staging)?;
        let held = File::create_new(folder.path().join(HELD))?;
        held.lock()?;
        Ok(Self { _held: held, folder })
    }

    pub(super) fn path(&self) -> &Path {
        self.folder.path()
    }
}

impl Blobs {
    /// Removes what processes that are gone have left behind.
    ///
    /// # Errors
    /// [`BlobError::Io`].
    pub async fn clear_staging(&self) -> Result<(), BlobError> {
        let (staging, lock) = (self.0.staging.clone(), self.0.lock.clone());
        let swept = blocking(move || {
            let guard = open_lock(&lock)?;
            guard.lock()?;
            sweep(&staging)
        });
        Ok(swept.await?)
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
            Ok(()) => tracing::info!(path = %path.display(), "removed what a process left that is gone"),
            // Its own process may have removed it meanwhile.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            // Litter is no reason not to start.
            Err(error) => tracing::warn!(path = %path.display(), "what a process left stays: {error}"),
        }
    }
    Ok(())
}

/// Whether a living process stages there, as far as can be told.
fn is_held(folder: &Path) -> bool {
    let opened = File::options().write(true).open(folder.join(HELD));
    match opened.map(|file| file.try_lock()) {
        Ok(Ok(())) => false,
        Ok(Err(TryLockError::WouldBlock)) => true,
        // Not a folder, or one whose process ended before it held it.
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => false,
        Ok(Err(TryLockError::Error(error))) | Err(error) => {
            tracing::warn!(path = %folder.display(), "cannot tell whether a process stages here: {error}");
            true
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_a_dead_process_left_goes_and_what_a_living_one_stages_stays() {
        let folder = tempfile::tempdir().expect("a folder");
        let living = Blobs::open(folder.path()).expect("opens");
        let mut staging = living.stage(100).await.expect("room");
        staging.write(b"half").await.expect("written");
        let dead = folder.path().join("staging/process-dead");
        let leave = || {
            fs::create_dir_all(&dead).expect("made");
            fs::write(dead.join(HELD), "").expect("made");
            fs::write(dead.join("upload-half"), b"half").expect("written");
        };
        leave();
        let other = Blobs::open(folder.path()).expect("opens again");
        assert!(!dead.exists(), "at the next opening");
        leave();
        living.clear_staging().await.expect("swept");
        assert!(!dead.exists(), "and by who keeps house");

        let staged = staging.finish().await.expect("whole");
        assert!(staged.path().exists());
        let rooms = || fs::read_dir(folder.path().join("staging")).expect("a folder").count();
        assert_eq!(rooms(), 2);
        drop(other);
        assert_eq!(rooms(), 1, "who ends in order takes it along");
    }

    #[test]
    fn what_cannot_be_removed_keeps_neither_the_rest_nor_the_store_from_its_place() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["a", "b", "c"] {
            fs::create_dir(folder.path().join(name)).expect("made");
        }
        // Root may remove anything, so the system refuses nothing here that every user would be refused.
        let swept = sweep_by(folder.path(), |path| match path.file_name().and_then(|name| name.to_str()) {
            Some("a") => Err(io::ErrorKind::PermissionDenied.into()),
            Some("b") => Err(io::ErrorKind::NotFound.into()),
            _ => fs::remove_dir_all(path),
        });
        swept.expect("litter is no reason to stop");
        let left = |name: &str| folder.path().join(name).exists();
        assert_eq!(["a", "b", "c"].map(left), [true, true, false]);
    }
}
