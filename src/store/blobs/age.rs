//! How old blobs are, and the end of those that nobody wants.
//!
//! To look at a blob's age and to act on it is one step, under a lock that every process with this store shares: a publisher that
//! finds the blob there makes it young (shared), whoever removes blobs looks again before it does (exclusive). So a blob is never
//! removed between its publication and the reference to it, as long as that takes less than the grace time.

use std::{
    fs::{self, File},
    io,
    path::{Path, PathBuf},
};

use jiff::Timestamp;

use super::{BlobError, Blobs, Staged, blocking, location};
use crate::{
    domain::{Clock as _, Digest, SystemClock},
    store::BlobRef,
};

impl Blobs {
    /// Whether the blob is there; if so, its age begins anew.
    pub(super) async fn renew(&self, blob: BlobRef) -> Result<bool, BlobError> {
        let path = self.0.store.path_to_filesystem(&location(blob.digest))?;
        let lock = self.0.lock.clone();
        let renewed = blocking(move || {
            let lock = open_lock(&lock)?;
            lock.lock_shared()?;
            let file = match File::options().write(true).open(&path) {
                Ok(file) => file,
                Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
                Err(error) => return Err(error),
            };
            if file.metadata()?.len() != blob.bytes {
                return Ok(false);
            }
            touch(&file)?;
            Ok(true)
        });
        Ok(renewed.await?)
    }

    /// Publishes a finished upload by giving its file the blob's name as well; false if it has to be copied.
    pub(super) async fn link(&self, staged: &Staged) -> Result<bool, BlobError> {
        if !staged.is_final() {
            return Ok(false);
        }
        let from = staged.path().to_owned();
        let to = self.0.store.path_to_filesystem(&location(staged.blob().digest))?;
        let root = self.0.root.clone();
        let linked = blocking(move || {
            let file = File::options().write(true).open(&from)?;
            touch(&file)?;
            file.sync_all()?;
            let folder = to.parent().unwrap_or(&root);
            fs::create_dir_all(folder)?;
            match fs::hard_link(&from, &to) {
                Ok(()) => {}
                // Published by somebody else meanwhile.
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => {
                    tracing::debug!("{} is copied, it cannot be linked: {error}", from.display());
                    return Ok(false);
                }
            }
            for folder in folder.ancestors().take_while(|folder| folder.starts_with(&root)) {
                sync_folder(folder)?;
            }
            Ok(true)
        });
        // A file of another length under that name is damage, which a copy mends.
        Ok(linked.await? && self.renew(staged.blob()).await?)
    }

    /// The blobs that were last published before `before`.
    ///
    /// # Errors
    /// [`BlobError::Io`].
    pub async fn older_than(&self, before: Timestamp) -> Result<Vec<Digest>, BlobError> {
        let root = self.0.root.join("sha256");
        let found = blocking(move || {
            let mut found = Vec::new();
            for outer in folders(&root)? {
                for inner in folders(&outer)? {
                    for file in entries(&inner)? {
                        let name = file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
                        match (name.parse(), age_of(&file)?) {
                            (Ok(digest), Some(at)) if at < before => found.push(digest),
                            // What the object store began to write there and a crash left.
                            (Err(_), Some(at)) if at < before && name.contains('#') => {
                                fs::remove_file(&file)?
                            }
                            _ => {}
                        }
                    }
                }
            }
            Ok(found)
        });
        Ok(found.await?)
    }

    /// Removes the blob if it was last published before `before`, and tells how many bytes that freed.
    ///
    /// # Errors
    /// [`BlobError::Io`] or [`BlobError::Store`].
    pub async fn remove_older(&self, digest: Digest, before: Timestamp) -> Result<Option<u64>, BlobError> {
        let path = self.0.store.path_to_filesystem(&location(digest))?;
        let lock = self.0.lock.clone();
        let removed = blocking(move || {
            let lock = open_lock(&lock)?;
            lock.lock()?;
            if age_of(&path)?.is_none_or(|at| at >= before) {
                return Ok(None);
            }
            let bytes = fs::metadata(&path)?.len();
            fs::remove_file(&path)?;
            Ok(Some(bytes))
        });
        Ok(removed.await?)
    }
}

/// File systems measure ages by the machine's clock, whatever clock jobs are measured by.
fn touch(file: &File) -> io::Result<()> {
    file.set_modified(SystemClock.now().into())
}

/// When the file was last touched; none if there is no such file.
pub(super) fn age_of(path: &Path) -> io::Result<Option<Timestamp>> {
    match fs::metadata(path) {
        Ok(metadata) => Timestamp::try_from(metadata.modified()?).map(Some).map_err(io::Error::other),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

/// Each process and each task opens the lock for itself; it is let go when the file is closed.
pub(super) fn open_lock(path: &Path) -> io::Result<File> {
    File::options().create(true).truncate(false).write(true).open(path)
}

/// Makes new names in a folder survive a power cut.
pub(super) fn sync_folder(path: &Path) -> io::Result<()> {
    // Elsewhere folders cannot be opened, and need not be.
    if cfg!(unix) { File::open(path)?.sync_all() } else { Ok(()) }
}

/// What is in a folder; nothing if there is none.
pub(super) fn entries(folder: &Path) -> io::Result<Vec<PathBuf>> {
    match fs::read_dir(folder) {
        Ok(entries) => entries.map(|entry| Ok(entry?.path())).collect(),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Vec::new()),
        Err(error) => Err(error),
    }
}

fn folders(folder: &Path) -> io::Result<Vec<PathBuf>> {
    Ok(entries(folder)?.into_iter().filter(|path| path.is_dir()).collect())
}
