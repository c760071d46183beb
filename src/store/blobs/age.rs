//! Ages of blobs: publication renews them, removal depends on them.
//!
//! Reading a blob's age and acting on it is one step, under a lock that all processes with this store share: a publisher that finds the
//! blob renews its age (shared lock), and removal checks the age again (exclusive lock). So a blob is never removed between its
//! publication and the reference to it, as long as that takes less than the grace time.

use std::{
    fs::{self, File},
    io,
};

use jiff::Timestamp;

use super::{
    BlobError, Blobs, Published, StagedBlob, blocking,
    files::{age_of, entries, folders, open_lock, sync_folder, touch},
    location,
};
use crate::{domain::Digest, store::BlobRef};

impl Blobs {
    /// Renews the blob's age and returns its new modification time; `None` if it does not exist.
    pub(super) async fn renew(&self, blob: BlobRef) -> Result<Option<Timestamp>, BlobError> {
        let path = self.0.store.path_to_filesystem(&location(blob.digest))?;
        let lock = self.0.lock.clone();
        blocking(move || {
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
        })
        .await
    }

    /// Publishes a staged blob by a hard link; `None` if it has to be copied.
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

    /// Undoes a publication: removes the blob if this publication created it and it was not published since. The caller has made sure
    /// that nothing refers to it. Returns whether it was removed.
    pub async fn unpublish(&self, published: Published) -> Result<bool, BlobError> {
        let Some(since) = published.created_at else { return Ok(false) };
        let removed = self.remove_if(published.blob.digest, move |at| at == since).await?;
        Ok(removed.is_some())
    }

    /// The blobs that were last published before `before`.
    pub async fn older_than(&self, before: Timestamp) -> Result<Vec<Digest>, BlobError> {
        let root = self.0.root.join("sha256");
        blocking(move || {
            let mut found = Vec::new();
            for outer in folders(&root)? {
                for inner in folders(&outer)? {
                    for file in entries(&inner)? {
                        let name = file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
                        match (name.parse(), age_of(&file)?) {
                            (Ok(digest), Some(at)) if at < before => found.push(digest),
                            // A temporary file of the object store, left by a crash.
                            (Err(_), Some(at)) if at < before && name.contains('#') => {
                                fs::remove_file(&file)?
                            }
                            _ => {}
                        }
                    }
                }
            }
            Ok(found)
        })
        .await
    }

    /// Removes the blob if it was last published before `before`, and returns the bytes freed.
    pub async fn remove_older(&self, digest: Digest, before: Timestamp) -> Result<Option<u64>, BlobError> {
        self.remove_if(digest, move |at| at < before).await
    }

    /// Removes the blob if `wanted` accepts its latest publication, and returns the bytes freed.
    async fn remove_if(
        &self,
        digest: Digest,
        wanted: impl FnOnce(Timestamp) -> bool + Send + 'static,
    ) -> Result<Option<u64>, BlobError> {
        let path = self.0.store.path_to_filesystem(&location(digest))?;
        let lock = self.0.lock.clone();
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
