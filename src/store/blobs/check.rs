//! Compares blobs with their names, and copies them from elsewhere.

use std::{
    fmt,
    path::{Path, PathBuf},
};

use bytes::Bytes;
use futures_util::{StreamExt as _, TryStreamExt as _, stream::BoxStream};
use object_store::GetOptions;
use tokio::fs::File;
use tokio_util::io::ReaderStream;

use super::{BlobBackend, BlobError, Blobs, ContentHasher, files::if_there, location};
use crate::{domain::Digest, store::BlobRef};

/// Bytes read at a time.
const PIECE: usize = 1 << 20;

/// How closely blobs are looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CheckDepth {
    /// Their lengths.
    Length,
    /// Their lengths and digests.
    Content,
}

/// What a blob's file was found to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BlobState {
    /// As its name says.
    Sound,
    /// Not there.
    Missing,
    /// Of another length or content.
    Damaged,
}

/// How blobs are copied.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CopyMode {
    /// By a second name for the same file where the file systems allow it, else by content.
    Link,
    Content,
}

/// Where blobs are copied from; it is only read.
#[derive(Debug, Clone)]
pub enum BlobSource {
    /// A data folder or a backup.
    Folder(PathBuf),
    /// An open store.
    Store(Blobs),
}

impl BlobSource {
    fn file(&self, digest: Digest) -> Option<PathBuf> {
        match self {
            Self::Folder(data) => Some(data.join("blobs").join(location(digest).to_string())),
            Self::Store(blobs) => blobs.file(digest),
        }
    }

    /// The content of a blob; `None` if it is not there.
    async fn open(
        &self,
        digest: Digest,
    ) -> Result<Option<BoxStream<'static, Result<Bytes, BlobError>>>, BlobError> {
        if let Some(path) = self.file(digest) {
            let Some(file) = open(&path).await? else { return Ok(None) };
            return Ok(Some(ReaderStream::with_capacity(file, PIECE).map_err(BlobError::from).boxed()));
        }
        let Self::Store(blobs) = self else { return Ok(None) };
        match blobs.get(digest, GetOptions::default()).await {
            Ok(content) => Ok(Some(content)),
            Err(BlobError::Missing(_)) => Ok(None),
            Err(error) => Err(error),
        }
    }
}

/// What the source's name is in messages.
impl fmt::Display for BlobSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Folder(data) => data.display().fmt(f),
            Self::Store(blobs) => blobs.fmt(f),
        }
    }
}

/// The file; `None` if there is none.
async fn open(path: &Path) -> Result<Option<File>, BlobError> {
    Ok(if_there(File::open(path).await)?)
}

/// The length of a file; `None` if there is none.
async fn length(path: &Path) -> Result<Option<u64>, BlobError> {
    Ok(if_there(tokio::fs::metadata(path).await)?.map(|metadata| metadata.len()))
}

impl Blobs {
    /// The blob's own file, whether it is there or not; `None` if blobs are no files.
    fn file(&self, digest: Digest) -> Option<PathBuf> {
        match &self.0.backend {
            BlobBackend::Folder(folder) => folder.path(digest).ok(),
            BlobBackend::Bucket(_) => None,
        }
    }

    /// Compares a blob with its name and length.
    ///
    /// # Errors
    /// [`BlobError`] if it cannot be read for another reason than its absence.
    pub async fn check(&self, blob: BlobRef, depth: CheckDepth) -> Result<BlobState, BlobError> {
        let found = match &self.0.backend {
            BlobBackend::Folder(folder) => length(&folder.path(blob.digest)?).await?,
            BlobBackend::Bucket(bucket) => bucket.length(blob.digest).await?,
        };
        match found {
            None => return Ok(BlobState::Missing),
            Some(bytes) if bytes != blob.bytes => return Ok(BlobState::Damaged),
            Some(_) if depth == CheckDepth::Length => return Ok(BlobState::Sound),
            Some(_) => {}
        }
        let Some(mut content) = BlobSource::Store(self.clone()).open(blob.digest).await? else {
            return Ok(BlobState::Missing);
        };
        let mut found = ContentHasher::new(u64::MAX);
        while let Some(piece) = content.try_next().await? {
            found.update(&piece)?;
        }
        Ok(if found.finish() == blob { BlobState::Sound } else { BlobState::Damaged })
    }

    /// Records a blob that is here for garbage collection, which lists the files of a folder but not the objects of a bucket. Returns false
    /// if it is not here any more.
    async fn record(&self, blob: BlobRef) -> Result<bool, BlobError> {
        match &self.0.backend {
            BlobBackend::Folder(_) => Ok(true),
            BlobBackend::Bucket(bucket) => Ok(bucket.renew(blob).await?.is_some()),
        }
    }

    /// Copies a blob from elsewhere, unless it is here; a copy by content is checked against its digest, and so is what a bucket has
    /// already. Returns what was found: nothing is copied of a blob that is missing or damaged there. A bucket must have no other users.
    ///
    /// # Errors
    /// [`BlobError`].
    pub async fn copy_from(
        &self,
        source: &BlobSource,
        blob: BlobRef,
        mode: CopyMode,
    ) -> Result<BlobState, BlobError> {
        let depth = match (&self.0.backend, mode) {
            // It was empty, so its files were checked when they were copied.
            (BlobBackend::Folder(_), _) | (_, CopyMode::Link) => CheckDepth::Length,
            (BlobBackend::Bucket(_), CopyMode::Content) => CheckDepth::Content,
        };
        let here = self.check(blob, depth).await?;
        if here == BlobState::Sound && self.record(blob).await? {
            return Ok(BlobState::Sound);
        }
        if mode == CopyMode::Link
            && let Some(from) = source.file(blob.digest)
            && let BlobBackend::Folder(folder) = &self.0.backend
        {
            match length(&from).await? {
                None => return Ok(BlobState::Missing),
                Some(bytes) if bytes != blob.bytes => return Ok(BlobState::Damaged),
                Some(_) => {}
            }
            if folder.link_from(from, blob.digest).await? {
                return Ok(BlobState::Sound);
            }
        }
        let Some(mut content) = source.open(blob.digest).await? else { return Ok(BlobState::Missing) };
        let mut staged = self.stage(blob.bytes).await?;
        while let Some(piece) = content.try_next().await? {
            match staged.write(&piece).await {
                Err(BlobError::TooLarge { .. }) => return Ok(BlobState::Damaged),
                written => written?,
            }
        }
        let staged = staged.finish().await?;
        if staged.blob() != blob {
            return Ok(BlobState::Damaged);
        }
        if let (BlobState::Damaged, BlobBackend::Bucket(bucket)) = (here, &self.0.backend) {
            // A publication keeps an object of the blob's length.
            bucket.delete(blob.digest).await?;
        }
        self.publish(&staged).await?;
        Ok(BlobState::Sound)
    }
}
