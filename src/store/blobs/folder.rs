//! Blobs as files of a local directory, kept through `object_store`, with their age as the modification time.
//!
//! Reading a blob's age and acting on it is one step, under a lock that all processes with this folder share: a publisher that finds the
//! blob renews its age (shared lock), and removal checks the age again (exclusive lock). So a blob is never removed between its
//! publication and the reference to it, as long as that takes less than the grace time.

use std::{
    fs::{self, File},
    io,
    path::{Path, PathBuf},
};

use jiff::Timestamp;
use object_store::local::LocalFileSystem;

use super::{
    BlobError, OldBlobs, Published, ROOT, StagedBlob, blocking,
    files::{age_of, entries, folders, if_there, open_lock, sync_folder, touch},
    location,
    parts::write_parts,
};
use crate::{domain::Digest, store::BlobRef};

/// The folder.
#[derive(Debug)]
pub(super) struct Folder {
    pub(super) store: LocalFileSystem,
    pub(super) root: PathBuf,
    /// Lock file that guards the ages of blobs among all processes with this folder.
    lock: PathBuf,
}

impl Folder {
    /// The folder `root`, which must be there.
    pub(super) fn open(root: PathBuf, lock: PathBuf) -> Result<Self, BlobError> {
        let store = LocalFileSystem::new_with_prefix(&root)?.with_fsync(true);
        Ok(Self { store, root, lock })
    }

    /// Where a blob's file is, or would be.
    pub(super) fn path(&self, digest: Digest) -> Result<PathBuf, BlobError> {
        Ok(self.store.path_to_filesystem(&location(digest))?)
    }

    /// Publishes a staged blob; keeps an existing equal one. Writes no copy if the file system has hard links.
    pub(super) async fn publish(&self, staged: &StagedBlob) -> Result<Published, BlobError> {
        let blob = staged.blob();
        if self.renew(blob).await?.is_some() {
            return Ok(Published { blob, created_at: None });
        }
        if let Some(published) = self.link(staged).await? {
            return Ok(published);
        }
        self.copy(staged).await?;
        self.renew(blob).await?;
        // Another publisher may have copied the same content meanwhile, so this publication cannot be undone.
        Ok(Published { blob, created_at: None })
    }

    async fn copy(&self, staged: &StagedBlob) -> Result<(), BlobError> {
        let content = tokio::fs::File::open(staged.path()).await?;
        let blob = staged.blob();
        write_parts(&self.store, &location(blob.digest), content, blob.bytes, BlobError::Store).await
    }

    /// Renews the blob's age and returns its new modification time; `None` if it does not exist.
    pub(super) async fn renew(&self, blob: BlobRef) -> Result<Option<Timestamp>, BlobError> {
        let path = self.path(blob.digest)?;
        let lock = self.lock.clone();
        blocking(move || {
            let lock = open_lock(&lock)?;
            lock.lock_shared()?;
            let Some(file) = if_there(File::options().write(true).open(&path))? else { return Ok(None) };
            if file.metadata()?.len() != blob.bytes {
                return Ok(None);
            }
            touch(&file).map(Some)
        })
        .await
    }

    /// Publishes a staged blob by a hard link; `None` if it has to be copied.
    async fn link(&self, staged: &StagedBlob) -> Result<Option<Published>, BlobError> {
        let blob = staged.blob();
        let from = staged.path().to_owned();
        let to = self.path(blob.digest)?;
        let root = self.root.clone();
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
                    tracing::debug!("copying {}, which cannot be linked: {error}", from.display());
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
            // Published by another task meanwhile. A file of another length under that name is damaged; a copy repairs it.
            Linked::Before => self.renew(blob).await?.map(|_| Published { blob, created_at: None }),
            Linked::Not => None,
        })
    }

    /// The blobs that were last published before `before`.
    pub(super) async fn older_than(&self, before: Timestamp) -> Result<OldBlobs, BlobError> {
        let root = self.root.join(ROOT);
        blocking(move || {
            let mut old = OldBlobs::default();
            for outer in folders(&root)? {
                for inner in old.noted(folders(&outer)) {
                    for file in old.noted(entries(&inner)) {
                        let added = old.add(&file, before);
                        old.noted(added);
                    }
                }
            }
            Ok(old)
        })
        .await
    }

    /// Removes the blob if `wanted` accepts its latest publication, and returns the bytes freed.
    pub(super) async fn remove_if(
        &self,
        digest: Digest,
        wanted: impl FnOnce(Timestamp) -> bool + Send + 'static,
    ) -> Result<Option<u64>, BlobError> {
        let path = self.path(digest)?;
        let lock = self.lock.clone();
        blocking(move || {
            let lock = open_lock(&lock)?;
            lock.lock()?;
            if !age_of(&path)?.is_some_and(wanted) {
                return Ok(None);
            }
            let bytes = fs::metadata(&path)?.len();
            fs::remove_file(&path)?;
            Ok(Some(bytes))
        })
        .await
    }

    /// Gives a file the name of a blob here too, and returns whether that was possible.
    pub(super) async fn link_from(&self, from: PathBuf, digest: Digest) -> Result<bool, BlobError> {
        let to = self.path(digest)?;
        let root = self.root.clone();
        blocking(move || {
            let Some(folder) = to.parent() else { return Ok(false) };
            fs::create_dir_all(folder)?;
            if fs::hard_link(&from, &to).is_err() {
                // Another file system, one without links, or a file that is gone; copying finds out which.
                return Ok(false);
            }
            for folder in folder.ancestors().take_while(|folder| folder.starts_with(&root)) {
                sync_folder(folder)?;
            }
            Ok(true)
        })
        .await
    }
}

impl OldBlobs {
    /// Adds the blob in a file if it was last published before `before`, or removes a temporary file of that age.
    fn add(&mut self, file: &Path, before: Timestamp) -> io::Result<()> {
        let name = file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        match (name.parse(), age_of(file)?) {
            (Ok(digest), Some(at)) if at < before => self.digests.push(digest),
            // A temporary file of the object store, left by a crash.
            (Err(_), Some(at)) if at < before && name.contains('#') => fs::remove_file(file)?,
            _ => {}
        }
        Ok(())
    }

    /// The value, or nothing after an error, so that one entry does not hide the others.
    fn noted<T: Default>(&mut self, value: io::Result<T>) -> T {
        value.unwrap_or_else(|error| {
            self.error.get_or_insert(error.into());
            T::default()
        })
    }
}

/// Result of a hard link to a blob's name.
enum Linked {
    /// Linked, with this modification time.
    Now(Timestamp),
    /// Not linked: the name exists.
    Before,
    /// Not linked: the file system does not support it.
    Not,
}
