//! Content on its way to become a blob.

use std::path::{Path, PathBuf};

use sha2::{Digest as _, Sha256};
use tempfile::{NamedTempFile, TempPath};
use tokio::{fs::File, io::AsyncWriteExt as _};

use super::{BlobError, UploadFile};
use crate::{domain::Digest, store::BlobRef};

/// A blob that is being written; dropping it removes its file.
#[derive(Debug)]
pub struct Staging {
    file: File,
    path: TempPath,
    hasher: Sha256,
    bytes: u64,
    limit: u64,
}

impl Staging {
    pub(super) fn new(file: NamedTempFile, limit: u64) -> Self {
        let (file, path) = file.into_parts();
        Self { file: File::from_std(file), path, hasher: Sha256::new(), bytes: 0, limit }
    }

    /// Appends a piece.
    ///
    /// # Errors
    /// [`BlobError::TooLarge`] once the limit is passed, [`BlobError::Io`].
    pub async fn write(&mut self, piece: &[u8]) -> Result<(), BlobError> {
        self.bytes += piece.len() as u64;
        if self.bytes > self.limit {
            return Err(BlobError::TooLarge { limit: self.limit });
        }
        self.hasher.update(piece);
        Ok(self.file.write_all(piece).await?)
    }

    /// Ends the blob.
    ///
    /// # Errors
    /// [`BlobError::Io`].
    pub async fn finish(mut self) -> Result<Staged, BlobError> {
        self.file.flush().await?;
        let digest = Digest::from_bytes(self.hasher.finalize().into());
        let blob = BlobRef { digest, bytes: self.bytes };
        Ok(Staged { path: self.path.to_path_buf(), source: Source::Staging { _removed: self.path }, blob })
    }
}

/// A complete blob that is not yet published.
#[derive(Debug)]
pub struct Staged {
    path: PathBuf,
    source: Source,
    blob: BlobRef,
}

/// Where the content lies.
#[derive(Debug)]
enum Source {
    /// In a private file that goes with this value.
    Staging { _removed: TempPath },
    /// In an upload's file, which stays and is not written to while this value lives.
    Upload { _locked: UploadFile },
}

impl Staged {
    pub(super) fn of_upload(path: PathBuf, file: UploadFile, blob: BlobRef) -> Self {
        Self { path, source: Source::Upload { _locked: file }, blob }
    }

    /// The file with the content.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What it will be published as.
    #[must_use]
    pub fn blob(&self) -> BlobRef {
        self.blob
    }

    /// Whether nobody will ever write to the file again, so that the blob may be the same file.
    pub(super) fn is_final(&self) -> bool {
        matches!(self.source, Source::Upload { .. })
    }
}
