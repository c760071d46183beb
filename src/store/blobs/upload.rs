//! Resumable uploads: files in a folder, or parts in a bucket.
//!
//! A file has one writer at a time among all processes: the holder of its lock, which the system releases when the writer ends, in
//! whatever way. After locking, a writer must read the upload's row again, since the holder before may have ended it. A file is never
//! shorter than the received bytes in the table; bytes beyond them are discarded.

use std::{
    fs::{self, File as StdFile, TryLockError},
    io::{self, Read as _},
    path::PathBuf,
};

use jiff::Timestamp;
use sha2::{Digest as _, Sha256};
use tokio::{
    fs::File,
    io::{AsyncSeekExt as _, AsyncWriteExt as _},
};

use super::{
    BlobBackend, BlobError, Blobs, StagedBlob, blocking,
    bucket::BucketUpload,
    files::{entries, if_there, sync_folder, write_through},
};
use crate::{
    domain::{Digest, UploadId},
    store::{BlobRef, Store},
};

const HASH_BUFFER: usize = 1 << 20;

/// An upload, locked until this is dropped.
#[derive(Debug)]
pub struct UploadFile {
    id: UploadId,
    content: UploadContent,
}

#[derive(Debug)]
enum UploadContent {
    File { file: File, path: PathBuf },
    Bucket(Box<BucketUpload>),
}

impl Blobs {
    fn upload_path(&self, id: UploadId) -> PathBuf {
        self.0.uploads.join(id.to_string())
    }

    /// Opens and locks an upload, and creates its file if there is none; `None` if another writer has locked it.
    pub async fn open_upload(&self, id: UploadId) -> Result<Option<UploadFile>, BlobError> {
        if let BlobBackend::Bucket(bucket) = &self.0.backend {
            let opened = bucket.open_upload(id, &self.0.staging_dir).await?;
            return Ok(opened.map(|upload| UploadFile { id, content: UploadContent::Bucket(upload.into()) }));
        }
        let (path, folder) = (self.upload_path(id), self.0.uploads.clone());
        blocking(move || {
            let is_new = !path.exists();
            let file = StdFile::options().create(true).truncate(false).read(true).write(true).open(&path)?;
            if is_new {
                sync_folder(&folder)?;
            }
            match file.try_lock() {
                Ok(()) => {
                    let content = UploadContent::File { file: File::from_std(file), path };
                    Ok(Some(UploadFile { id, content }))
                }
                Err(TryLockError::WouldBlock) => Ok(None),
                Err(TryLockError::Error(error)) => Err(error),
            }
        })
        .await
    }

    /// Removes the bytes of an ended upload; false if a writer has locked it.
    pub async fn remove_upload(&self, id: UploadId) -> Result<bool, BlobError> {
        if let BlobBackend::Bucket(bucket) = &self.0.backend {
            return bucket.remove_upload(id).await;
        }
        let path = self.upload_path(id);
        blocking(move || {
            let Some(file) = if_there(StdFile::options().write(true).open(&path))? else { return Ok(true) };
            match file.try_lock() {
                Ok(()) => fs::remove_file(&path).map(|()| true),
                Err(TryLockError::WouldBlock) => Ok(false),
                Err(TryLockError::Error(error)) => Err(error),
            }
        })
        .await
    }

    /// Every upload that has bytes here.
    pub async fn uploads(&self) -> Result<Vec<UploadId>, BlobError> {
        if let BlobBackend::Bucket(bucket) = &self.0.backend {
            return bucket.uploads().await;
        }
        let folder = self.0.uploads.clone();
        blocking(move || {
            let files = entries(&folder)?;
            Ok(files.iter().filter_map(|path| path.file_name()?.to_str()?.parse().ok()).collect())
        })
        .await
    }
}

impl UploadFile {
    /// Forgets what is beyond the received bytes, and appends from there.
    ///
    /// # Errors
    /// [`BlobError::UploadDamaged`] if a file is shorter, [`BlobError::Io`].
    pub async fn continue_at(&mut self, received: u64) -> Result<(), BlobError> {
        let file = match &mut self.content {
            UploadContent::Bucket(upload) => return upload.continue_at(received).await,
            UploadContent::File { file, .. } => file,
        };
        let found = file.metadata().await?.len();
        if found < received {
            return Err(BlobError::UploadDamaged { id: self.id, expected: received, found });
        }
        file.set_len(received).await?;
        file.seek(io::SeekFrom::Start(received)).await?;
        Ok(())
    }

    /// Appends a piece. Once this returns, the file system has taken it.
    pub async fn write(&mut self, piece: &[u8]) -> Result<(), BlobError> {
        match &mut self.content {
            UploadContent::File { file, .. } => Ok(write_through(file, piece).await?),
            UploadContent::Bucket(upload) => upload.write(piece).await,
        }
    }

    /// Makes the bytes up to `received` durable, and then records them as received; false if the upload has ended.
    ///
    /// # Errors
    /// [`BlobError::Io`], [`BlobError::Bucket`], [`BlobError::Index`].
    pub async fn save(
        &mut self,
        store: &Store,
        received: u64,
        expires_at: Timestamp,
    ) -> Result<bool, BlobError> {
        match &mut self.content {
            UploadContent::File { .. } => {
                self.sync().await?;
                Ok(store.advance_upload(self.id, received, expires_at).await?)
            }
            UploadContent::Bucket(upload) => upload.save(received, expires_at).await,
        }
    }

    /// Flushes the bytes written to a file to disk; those for a bucket are durable only once saved.
    pub async fn sync(&mut self) -> Result<(), BlobError> {
        let UploadContent::File { file, .. } = &mut self.content else { return Ok(()) };
        file.flush().await?;
        Ok(file.sync_data().await?)
    }

    /// Hashes the complete upload for publication. It stays locked meanwhile.
    ///
    /// # Errors
    /// [`BlobError::UploadDamaged`] if it has not `length` bytes, [`BlobError::Io`], [`BlobError::Bucket`].
    pub async fn finish(self, length: u64) -> Result<StagedBlob, BlobError> {
        let (file, path) = match self.content {
            UploadContent::File { file, path } => (file, path),
            UploadContent::Bucket(upload) => {
                let (upload, blob) = upload.finish(length).await?;
                return Ok(StagedBlob::of_upload(upload.path().to_owned(), upload, blob));
            }
        };
        let read = path.clone();
        let (digest, found) = blocking(move || {
            let mut file = StdFile::open(read)?;
            let (mut hasher, mut buffer, mut found) = (Sha256::new(), vec![0; HASH_BUFFER], 0_u64);
            loop {
                let count = file.read(&mut buffer)?;
                if count == 0 {
                    return Ok((Digest::from_bytes(hasher.finalize().into()), found));
                }
                hasher.update(&buffer[..count]);
                found += count as u64;
            }
        })
        .await?;
        if found != length {
            return Err(BlobError::UploadDamaged { id: self.id, expected: length, found });
        }
        Ok(StagedBlob::of_upload(path, file, BlobRef { digest, bytes: length }))
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[tokio::test]
    async fn a_piece_that_the_disk_does_not_take_fails_by_itself() {
        // A device that is always full.
        let path = PathBuf::from("/dev/full");
        let file = StdFile::options().write(true).open(&path).expect("a device");
        let content = UploadContent::File { file: File::from_std(file), path };
        let mut upload = UploadFile { id: UploadId(Uuid::from_u128(1)), content };
        for piece in [b"first", b"later"] {
            let error = upload.write(piece).await.expect_err("there is no room");
            assert!(error.is_disk_full(), "{error}");
        }
    }
}
