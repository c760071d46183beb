//! Staging: content before it is published as a blob.

use std::{
    fmt::Debug,
    path::{Path, PathBuf},
};

use sha2::{Digest as _, Sha256};
use tempfile::{NamedTempFile, TempPath};
use tokio::{fs::File, io::AsyncWriteExt as _};

use super::{BlobError, blocking};
use crate::{domain::Digest, store::BlobRef};

/// Hashes and counts content of a bounded length.
#[derive(Debug)]
pub struct ContentHasher {
    hasher: Sha256,
    bytes: u64,
    limit: u64,
}

impl ContentHasher {
    /// For content of at most `limit` bytes.
    #[must_use]
    pub fn new(limit: u64) -> Self {
        Self { hasher: Sha256::new(), bytes: 0, limit }
    }

    /// Appends a piece.
    ///
    /// # Errors
    /// [`BlobError::TooLarge`] once the limit is passed.
    pub fn update(&mut self, piece: &[u8]) -> Result<(), BlobError> {
        self.bytes += piece.len() as u64;
        if self.bytes > self.limit {
            return Err(BlobError::TooLarge { limit: self.limit });
        }
        self.hasher.update(piece);
        Ok(())
    }

    /// How much was appended.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// The blob that the content would be published as.
    #[must_use]
    pub fn finish(self) -> BlobRef {
        BlobRef { digest: Digest::from_bytes(self.hasher.finalize().into()), bytes: self.bytes }
    }
}

/// A blob that is being written; dropping it removes its file.
#[derive(Debug)]
pub struct BlobWriter {
    file: File,
    path: TempPath,
    content: ContentHasher,
}

impl BlobWriter {
    pub(super) fn new(file: NamedTempFile, limit: u64) -> Self {
        let (file, path) = file.into_parts();
        Self { file: File::from_std(file), path, content: ContentHasher::new(limit) }
    }

    /// Appends a piece.
    ///
    /// # Errors
    /// [`BlobError::TooLarge`] once the limit is passed, [`BlobError::Io`].
    pub async fn write(&mut self, piece: &[u8]) -> Result<(), BlobError> {
        self.content.update(piece)?;
        Ok(self.file.write_all(piece).await?)
    }

    /// Removes the file and goes on hashing only, up to `limit` bytes in total.
    pub async fn into_hasher(self, limit: u64) -> Result<ContentHasher, BlobError> {
        let Self { file, path, content } = self;
        drop(file);
        blocking(move || path.close()).await?;
        Ok(ContentHasher { limit, ..content })
    }

    /// Completes the blob.
    pub async fn finish(mut self) -> Result<StagedBlob, BlobError> {
        self.file.flush().await?;
        // No writes follow, so the file may be linked to the blob's name.
        drop(self.file);
        let blob = self.content.finish();
        Ok(StagedBlob {
            path: self.path.to_path_buf(),
            _source: Source::Staging { _removed: self.path },
            blob,
        })
    }
}

/// A complete blob that is not yet published. Its file does not change.
#[derive(Debug)]
pub struct StagedBlob {
    path: PathBuf,
    _source: Source,
    blob: BlobRef,
}

/// The file of the content.
#[derive(Debug)]
enum Source {
    /// A private file that is removed with this value.
    Staging { _removed: TempPath },
    /// An upload, which is locked against writes while this value lives.
    Upload { _locked: Box<dyn Debug + Send + Sync> },
}

impl StagedBlob {
    /// The content of an upload in the file `path`, locked by `lock`.
    pub(super) fn of_upload(path: PathBuf, lock: impl Debug + Send + Sync + 'static, blob: BlobRef) -> Self {
        Self { path, _source: Source::Upload { _locked: Box::new(lock) }, blob }
    }

    /// The file with the content.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The blob that it will be published as.
    #[must_use]
    pub fn blob(&self) -> BlobRef {
        self.blob
    }
}
