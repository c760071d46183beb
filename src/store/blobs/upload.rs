//! Files of resumable uploads.
//!
//! A file has one writer at a time among all processes: the holder of its lock, which the system releases when the writer ends, in
//! whatever way. After locking, a writer must read the upload's row again, since the holder before may have ended it. A file is never
//! shorter than the received bytes in the table; bytes beyond them are discarded.

use std::{
    fs::{self, File as StdFile, TryLockError},
    io::{self, Read as _},
    path::PathBuf,
};

use sha2::{Digest as _, Sha256};
use tokio::{
    fs::File,
    io::{AsyncSeekExt as _, AsyncWriteExt as _},
};

use super::{
    BlobError, Blobs, StagedBlob, blocking,
    files::{entries, sync_folder},
};
use crate::{
    domain::{Digest, UploadId},
    store::BlobRef,
};

const HASH_BUFFER: usize = 1 << 20;

/// An upload's file, locked until this is dropped.
#[derive(Debug)]
pub struct UploadFile {
    id: UploadId,
    file: File,
    path: PathBuf,
}

impl Blobs {
    fn upload_path(&self, id: UploadId) -> PathBuf {
        self.0.uploads.join(id.to_string())
    }

    /// Opens and locks an upload's file, and creates it if there is none; `None` if another writer has locked it.
    pub async fn open_upload(&self, id: UploadId) -> Result<Option<UploadFile>, BlobError> {
        let (path, folder) = (self.upload_path(id), self.0.uploads.clone());
        blocking(move || {
            let is_new = !path.exists();
            let file = StdFile::options().create(true).truncate(false).read(true).write(true).open(&path)?;
            if is_new {
                sync_folder(&folder)?;
            }
            match file.try_lock() {
                Ok(()) => Ok(Some(UploadFile { id, file: File::from_std(file), path })),
                Err(TryLockError::WouldBlock) => Ok(None),
                Err(TryLockError::Error(error)) => Err(error),
            }
        })
        .await
    }

    /// Removes the file of an ended upload; false if a writer has locked it.
    pub async fn remove_upload(&self, id: UploadId) -> Result<bool, BlobError> {
        let path = self.upload_path(id);
        blocking(move || {
            let file = match StdFile::options().write(true).open(&path) {
                Ok(file) => file,
                Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(true),
                Err(error) => return Err(error),
            };
            match file.try_lock() {
                Ok(()) => fs::remove_file(&path).map(|()| true),
                Err(TryLockError::WouldBlock) => Ok(false),
                Err(TryLockError::Error(error)) => Err(error),
            }
        })
        .await
    }

    /// Every upload that has a file.
    pub async fn uploads(&self) -> Result<Vec<UploadId>, BlobError> {
        let folder = self.0.uploads.clone();
        blocking(move || {
            let files = entries(&folder)?;
            Ok(files.iter().filter_map(|path| path.file_name()?.to_str()?.parse().ok()).collect())
        })
        .await
    }
}

impl UploadFile {
    /// Truncates the file to the received bytes, and appends from there.
    ///
    /// # Errors
    /// [`BlobError::UploadDamaged`] if the file is shorter, [`BlobError::Io`].
    pub async fn continue_at(&mut self, received: u64) -> Result<(), BlobError> {
        let found = self.file.metadata().await?.len();
        if found < received {
            return Err(BlobError::UploadDamaged { id: self.id, expected: received, found });
        }
        self.file.set_len(received).await?;
        self.file.seek(io::SeekFrom::Start(received)).await?;
        Ok(())
    }

    /// Appends a piece.
    pub async fn write(&mut self, piece: &[u8]) -> Result<(), BlobError> {
        Ok(self.file.write_all(piece).await?)
    }

    /// Flushes the bytes written to disk; only then do they count as received.
    pub async fn sync(&mut self) -> Result<(), BlobError> {
        self.file.flush().await?;
        Ok(self.file.sync_data().await?)
    }

    /// Hashes the complete file for publication. The upload stays locked meanwhile.
    ///
    /// # Errors
    /// [`BlobError::UploadDamaged`] if the file has not `length` bytes, [`BlobError::Io`].
    pub async fn finish(self, length: u64) -> Result<StagedBlob, BlobError> {
        let path = self.path.clone();
        let (digest, found) = blocking(move || {
            let mut file = StdFile::open(path)?;
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
        Ok(StagedBlob::of_upload(self.path, self.file, BlobRef { digest, bytes: length }))
    }
}
