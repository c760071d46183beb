//! Files of uploads that come in parts.
//!
//! A file has one writer at a time, in all processes: the one that holds its lock, which the system lets go when the writer ends,
//! however it ends. A writer that has got the lock must look the upload up once more before it writes; whoever had the lock before may
//! have ended it. A file is never shorter than what the table says was received, and what it has beyond that is void.

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
    BlobError, Blobs, StagedBlob,
    age::{entries, sync_folder},
    blocking,
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

    /// Takes hold of an upload's file, which is made if it is not there; none if somebody else holds it.
    ///
    /// # Errors
    /// [`BlobError::Io`].
    pub async fn open_upload(&self, id: UploadId) -> Result<Option<UploadFile>, BlobError> {
        let (path, folder) = (self.upload_path(id), self.0.uploads.clone());
        let opened = blocking(move || {
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
        });
        Ok(opened.await?)
    }

    /// Removes the file of an upload that has ended; false if somebody holds it.
    ///
    /// # Errors
    /// [`BlobError::Io`].
    pub async fn remove_upload(&self, id: UploadId) -> Result<bool, BlobError> {
        let path = self.upload_path(id);
        let removed = blocking(move || {
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
        });
        Ok(removed.await?)
    }

    /// Every upload that has a file.
    ///
    /// # Errors
    /// [`BlobError::Io`].
    pub async fn uploads(&self) -> Result<Vec<UploadId>, BlobError> {
        let folder = self.0.uploads.clone();
        let found = blocking(move || {
            let files = entries(&folder)?;
            Ok(files.iter().filter_map(|path| path.file_name()?.to_str()?.parse().ok()).collect())
        });
        Ok(found.await?)
    }
}

impl UploadFile {
    /// Goes to the end of what was received and drops what lies beyond it.
    ///
    /// # Errors
    /// [`BlobError::UploadDamaged`] if less is there, [`BlobError::Io`].
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
    ///
    /// # Errors
    /// [`BlobError::Io`].
    pub async fn write(&mut self, piece: &[u8]) -> Result<(), BlobError> {
        Ok(self.file.write_all(piece).await?)
    }

    /// Brings what was written to disk; only then may it be called received.
    ///
    /// # Errors
    /// [`BlobError::Io`].
    pub async fn sync(&mut self) -> Result<(), BlobError> {
        self.file.flush().await?;
        Ok(self.file.sync_data().await?)
    }

    /// Reads the file, which has come whole, and makes it ready to be published. The upload stays locked meanwhile.
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
        Ok(StagedBlob::of_upload(self.path.clone(), self, BlobRef { digest, bytes: length }))
    }
}
