//! Resumable uploads in a bucket: each saved part is an object of its own, and the database says which parts count.
//!
//! An upload has one writer at a time among all processes, which renews its lock for as long as it lives. One that has lost the lock
//! without noticing can save nothing any more.

use std::time::Duration;

use futures_util::TryStreamExt as _;
use jiff::Timestamp;
use tempfile::TempPath;
use tokio::{
    fs::File,
    io::{AsyncSeekExt as _, AsyncWriteExt as _},
    runtime::Handle,
    task::JoinHandle,
    time::{Instant, sleep},
};

use super::{BlobError, Bucket, ContentHasher, SharedFiles, StagingDir};
use crate::{
    domain::UploadId,
    store::{BlobRef, Store, blobs::files::write_through, uploads::UploadWriter},
};

/// Folder of all uploads.
const ROOT: &str = "uploads";

/// Time between two renewals of the lock.
const RENEW_EVERY: Duration = Duration::from_secs(15);

/// How long a lock is asked for: a writer that has just ended releases it a moment later.
const LOCK_PATIENCE: Duration = Duration::from_millis(500);
const LOCK_PAUSE: Duration = Duration::from_millis(20);

fn folder(id: UploadId) -> String {
    format!("{ROOT}/{id}")
}

/// An upload in a bucket, locked until this is dropped. What is not saved yet is in a private file.
#[derive(Debug)]
pub(in crate::store::blobs) struct BucketUpload {
    writer: UploadWriter,
    files: SharedFiles,
    lock: Lock,
    file: File,
    path: TempPath,
    /// Bytes of the upload before those of the private file.
    saved: u64,
}

/// Renews a writer's lock until it is dropped, and then releases it.
struct Lock {
    writer: UploadWriter,
    store: Store,
    renewing: JoinHandle<()>,
}

impl std::fmt::Debug for Lock {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Lock").field(&self.writer).finish()
    }
}

impl Lock {
    fn new(writer: UploadWriter, store: Store) -> Self {
        let renewed = store.clone();
        let renewing = tokio::spawn(async move {
            loop {
                sleep(RENEW_EVERY).await;
                if let Ok(false) = renewed.renew_upload_lock(writer).await {
                    return;
                }
            }
        });
        Self { writer, store, renewing }
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        self.renewing.abort();
        let (store, writer) = (self.store.clone(), self.writer);
        // Where there is no runtime any more, it ends by itself.
        if let Ok(runtime) = Handle::try_current() {
            runtime.spawn(async move { store.unlock_upload(writer).await });
        }
    }
}

impl Bucket {
    async fn lock_upload(&self, id: UploadId) -> Result<Option<Lock>, BlobError> {
        let started = Instant::now();
        loop {
            if let Some(writer) = self.store.lock_upload(id).await? {
                return Ok(Some(Lock::new(writer, self.store.clone())));
            }
            if started.elapsed() >= LOCK_PATIENCE || !self.store.is_upload(id).await? {
                return Ok(None);
            }
            sleep(LOCK_PAUSE).await;
        }
    }

    /// Locks an upload; `None` if another writer has locked it.
    pub(in crate::store::blobs) async fn open_upload(
        &self,
        id: UploadId,
        staging: &StagingDir,
    ) -> Result<Option<BucketUpload>, BlobError> {
        let Some(lock) = self.lock_upload(id).await? else { return Ok(None) };
        let file = tempfile::Builder::new().prefix("part-").tempfile_in(staging.path())?;
        let (file, path) = file.into_parts();
        let files = self.shared_files();
        Ok(Some(BucketUpload {
            writer: lock.writer,
            files,
            lock,
            file: File::from_std(file),
            path,
            saved: 0,
        }))
    }

    /// Removes what there is of an ended upload; false if a writer has locked it.
    pub(in crate::store::blobs) async fn remove_upload(&self, id: UploadId) -> Result<bool, BlobError> {
        // A row that is gone cannot be locked, and nobody writes.
        let lock = self.lock_upload(id).await?;
        if lock.is_none() && self.store.is_upload(id).await? {
            return Ok(false);
        }
        self.shared_files().remove_below(&folder(id)).await?;
        Ok(true)
    }

    /// Every upload of which there is something.
    pub(in crate::store::blobs) async fn uploads(&self) -> Result<Vec<UploadId>, BlobError> {
        let folders = self.shared_files().folders(ROOT).await?;
        Ok(folders.iter().filter_map(|name| name.parse().ok()).collect())
    }
}

impl BucketUpload {
    /// Appends after the received bytes from now on, and forgets what was not saved.
    pub(in crate::store::blobs) async fn continue_at(&mut self, received: u64) -> Result<(), BlobError> {
        self.file.set_len(0).await?;
        self.file.rewind().await?;
        self.saved = received;
        Ok(())
    }

    /// Appends a piece. Once this returns, the private file has it.
    pub(in crate::store::blobs) async fn write(&mut self, piece: &[u8]) -> Result<(), BlobError> {
        Ok(write_through(&mut self.file, piece).await?)
    }

    /// Saves what was written, up to byte `received`; false if the upload has ended or the lock is lost.
    pub(in crate::store::blobs) async fn save(
        &mut self,
        received: u64,
        expires_at: Timestamp,
    ) -> Result<bool, BlobError> {
        let name = format!("{}/{}-{}", folder(self.writer.id), self.saved, self.writer.number);
        if received > self.saved {
            // A write that failed may have left some of its piece behind.
            self.file.set_len(received - self.saved).await?;
            self.files.save(&name, &self.path).await?;
        }
        let (writer, start) = (self.writer, self.saved);
        let counts = self.lock.store.add_upload_part(writer, start, &name, received, expires_at).await?;
        if counts {
            self.continue_at(received).await?;
        }
        Ok(counts)
    }

    /// Brings the parts together in the private file, and returns it and what it is.
    ///
    /// # Errors
    /// [`BlobError::UploadDamaged`] if they have not `length` bytes.
    pub(in crate::store::blobs) async fn finish(mut self, length: u64) -> Result<(Self, BlobRef), BlobError> {
        self.continue_at(0).await?;
        let mut hasher = ContentHasher::new(u64::MAX);
        let mut end = 0;
        for (start, name) in self.lock.store.upload_parts(self.writer.id).await? {
            if start != end {
                break;
            }
            let mut content = self.files.content(&name).await?;
            while let Some(piece) = content.try_next().await? {
                hasher.update(&piece)?;
                self.file.write_all(&piece).await?;
                end += piece.len() as u64;
            }
        }
        self.file.flush().await?;
        if end != length {
            return Err(BlobError::UploadDamaged { id: self.writer.id, expected: length, found: end });
        }
        Ok((self, hasher.finish()))
    }

    /// The private file.
    pub(in crate::store::blobs) fn path(&self) -> &std::path::Path {
        &self.path
    }
}
