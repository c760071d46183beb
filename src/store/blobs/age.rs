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

use super::{BlobError, Blobs, Published, StagedBlob, blocking, location};
use crate::{
    domain::{Clock as _, Digest, SystemClock},
    store::BlobRef,
};

impl Blobs {
    /// When the blob's age began anew, which is now; none if it is not there.
    pub(super) async fn renew(&self, blob: BlobRef) -> Result<Option<Timestamp>, BlobError> {
        let path = self.0.store.path_to_filesystem(&location(blob.digest))?;
        let lock = self.0.lock.clone();
        let renewed = blocking(move || {
            let lock = open_lock(&lock)?;
            lock.lock_shared()?;
            let file = match File::options().write(true).open(&path) {
                Ok(file) => file,
                Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
                Err(error) => return Err(error),
            };
            if file.metadata()?.len() != blob.bytes {
                return Ok(None);
            }
            touch(&file).map(Some)
        });
        Ok(renewed.await?)
    }

    /// Publishes a blob by giving its file the blob's name as well; none if it has to be copied.
    pub(super) async fn link(&self, staged: &StagedBlob) -> Result<Option<Published>, BlobError> {
        let blob = staged.blob();
        let from = staged.path().to_owned();
        let to = self.0.store.path_to_filesystem(&location(blob.digest))?;
        let root = self.0.root.clone();
        let linked = blocking(move || {
            let file = File::options().write(true).open(&from)?;
            let touched = touch(&file)?;
            file.sync_all()?;
            let folder = to.parent().unwrap_or(&root);
            fs::create_dir_all(folder)?;
            let linked = match fs::hard_link(&from, &to) {
                Ok(()) => Linked::Now(touched),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Linked::Before,
                Err(error) => {
                    tracing::debug!("{} is copied, it cannot be linked: {error}", from.display());
                    return Ok(Linked::Not);
                }
            };
            for folder in folder.ancestors().take_while(|folder| folder.starts_with(&root)) {
                sync_folder(folder)?;
            }
            Ok(linked)
        });
        Ok(match linked.await? {
            Linked::Now(touched) => Some(Published { blob, created_at: Some(touched) }),
            // Published by somebody else meanwhile. A file of another length under that name is damage, which a copy mends.
            Linked::Before => self.renew(blob).await?.map(|_| Published { blob, created_at: None }),
            Linked::Not => None,
        })
    }

    /// Takes a publication back: removes the blob if this publication made it and nobody has published it since. Whoever calls this
    /// has made sure that nothing refers to it. Tells whether it was removed.
    ///
    /// # Errors
    /// [`BlobError::Io`] or [`BlobError::Store`].
    pub async fn unpublish(&self, published: Published) -> Result<bool, BlobError> {
        let Some(since) = published.created_at else { return Ok(false) };
        let removed = self.remove_if(published.blob.digest, move |at| at == since).await?;
        Ok(removed.is_some())
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
        self.remove_if(digest, move |at| at < before).await
    }

    /// Removes the blob if its latest publication is as wanted, and tells how many bytes that freed.
    async fn remove_if(
        &self,
        digest: Digest,
        wanted: impl FnOnce(Timestamp) -> bool + Send + 'static,
    ) -> Result<Option<u64>, BlobError> {
        let path = self.0.store.path_to_filesystem(&location(digest))?;
        let lock = self.0.lock.clone();
        let removed = blocking(move || {
            let lock = open_lock(&lock)?;
            lock.lock()?;
            if !age_of(&path)?.is_some_and(wanted) {
                return Ok(None);
            }
            let bytes = fs::metadata(&path)?.len();
            fs::remove_file(&path)?;
            Ok(Some(bytes))
        });
        Ok(removed.await?)
    }
}

/// Whether a staged file has a blob's name.
enum Linked {
    /// Since it was given it, with this age.
    Now(Timestamp),
    /// No: another file has that name.
    Before,
    /// No: the file system does not do this.
    Not,
}

/// File systems measure ages by the machine's clock, whatever clock jobs are measured by.
fn touch(file: &File) -> io::Result<Timestamp> {
    let now = SystemClock.now();
    file.set_modified(now.into())?;
    Ok(now)
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
