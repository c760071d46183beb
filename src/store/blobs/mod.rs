//! Blobs named by the SHA-256 of their content, kept through `object_store` in a local directory or in a bucket.
//!
//! A blob is staged (streamed to a private file while it is hashed and counted), then published under
//! `sha256/ab/cd/<digest>` in one atomic step; in a directory, with its bytes and directory entries flushed to disk. A published
//! blob is complete, never changes, and publishing it again changes nothing. A crash in between leaves a staging file or
//! an unreferenced blob, never a partial one.
//!
//! Each publication renews a blob's age. Only blobs older than a grace time are removed, so a publisher has that long to add a reference.
//! In a directory the age is the file's modification time; for a bucket the database keeps it.

mod bucket;
mod check;
mod files;
mod folder;
mod parts;
mod staging;
mod staging_dir;
#[cfg(test)]
mod tests;
mod upload;
mod verified;

use std::{
    fmt,
    io::{self, Write as _},
    ops::Range,
    path::{Path, PathBuf},
    sync::Arc,
};

use bytes::Bytes;
use futures_util::{
    StreamExt as _, TryStreamExt as _,
    stream::{self, BoxStream},
};
use jiff::{SignedDuration, Timestamp};
use object_store::{GetOptions, GetRange, ObjectStore, ObjectStoreExt as _, path::Path as ObjectPath};
use tempfile::TempPath;
use thiserror::Error;
use tokio::sync::{Notify, futures::Notified};

pub use bucket::{BucketUrl, InvalidBucketUrl, SharedFiles};
pub use check::{BlobSource, BlobState, CheckDepth, CopyMode};
pub use staging::{BlobWriter, ContentHasher, StagedBlob};
pub use upload::UploadFile;

use self::{bucket::Bucket, folder::Folder, staging_dir::StagingDir};
use super::{BlobRef, Store, StoreError, earlier, is_disk_full, publications::Removable};
use crate::domain::{Digest, UploadId};

/// Content as a stream.
type Pieces = BoxStream<'static, Result<Bytes, BlobError>>;

/// Folder of all blobs.
const ROOT: &str = "sha256";

/// Longest content that is hashed on a thread that others wait for, and at a time where there is more.
const HASHED_AT_ONCE: usize = 1 << 20;

/// Common block size of file systems.
const PROBE_BYTES: usize = 4096;

/// An error of the blob store.
#[derive(Debug, Error)]
pub enum BlobError {
    /// More bytes than the limit.
    #[error("the content is longer than the limit of {limit} bytes")]
    TooLarge { limit: u64 },
    /// There is no such blob.
    #[error("there is no blob {0}")]
    Missing(Digest),
    /// Bytes of an upload that were on disk are missing.
    #[error("upload {id} has {found} bytes on disk instead of {expected}")]
    UploadDamaged {
        id: UploadId,
        /// The recorded length.
        expected: u64,
        /// The length found.
        found: u64,
    },
    /// A blob's content does not have the digest that names it.
    #[error("blob {expected} is damaged: its content has the digest {actual}")]
    Damaged {
        /// The digest in its name.
        expected: Digest,
        /// The digest of its content.
        actual: Digest,
    },
    /// The bucket is another database's.
    #[error(
        "the bucket is in use by another database; name another bucket, or another prefix: s3://BUCKET/PREFIX"
    )]
    OtherDatabase,
    /// The database's blobs are in another bucket.
    #[error(
        "the bucket has none of this database's files: name the bucket and the prefix that they are in, or move them with 'tcgs backup' \
         and 'tcgs restore --blobs'"
    )]
    OtherBucket,
    /// An I/O error.
    #[error("a file of the blob store cannot be read or written")]
    Io(#[from] io::Error),
    /// The object store over the data folder failed.
    #[error("the object store failed")]
    Store(#[from] object_store::Error),
    /// The bucket did not answer, or refused.
    #[error("the bucket cannot be read or written")]
    Bucket(#[source] object_store::Error),
    /// The database that knows what is in the bucket failed.
    #[error(transparent)]
    Index(#[from] StoreError),
}

impl BlobError {
    /// An error of a bucket that does not answer.
    #[cfg(test)]
    pub(crate) fn of_a_silent_bucket() -> Self {
        let source = Box::new(std::io::Error::other("silent"));
        Self::Bucket(object_store::Error::Generic { store: "S3", source })
    }

    /// Whether the disk is full.
    #[must_use]
    pub fn is_disk_full(&self) -> bool {
        is_disk_full(self)
    }

    /// Whether the same call may succeed a while later, since a server did not answer or answered no. A bucket that refuses keys may take
    /// them once they are mended.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Bucket(_) => true,
            Self::Index(error) => error.is_transient(),
            _ => false,
        }
    }
}

/// A published blob.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Published {
    pub blob: BlobRef,
    /// When it was published, if this publication created it.
    created_at: Option<Timestamp>,
}

/// Blobs of some age.
#[derive(Debug, Default)]
pub struct OldBlobs {
    /// Those that were found.
    pub digests: Vec<Digest>,
    /// The first error, if something could not be looked at, or a temporary file not be removed.
    pub error: Option<BlobError>,
}

impl OldBlobs {
    /// All of them.
    ///
    /// # Errors
    /// The error, if there was one.
    pub fn all(self) -> Result<Vec<Digest>, BlobError> {
        self.error.map_or(Ok(self.digests), Err)
    }
}

/// A blob as a file to read, which lasts as long as this value: the blob's own, or a copy.
#[derive(Debug)]
pub struct BlobCopy {
    path: PathBuf,
    _removed: Option<TempPath>,
}

impl BlobCopy {
    /// The file; it must not be written.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// The blob store; clones share it.
#[derive(Debug, Clone)]
pub struct Blobs(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    backend: BlobBackend,
    /// Folder on the file system of the local files.
    data: PathBuf,
    staging: PathBuf,
    /// This process's folder in `staging`.
    staging_dir: StagingDir,
    uploads: PathBuf,
    /// Lock file of `staging`, and of the folder of blobs.
    lock: PathBuf,
    request_collection: Notify,
}

/// What keeps published blobs.
#[derive(Debug)]
enum BlobBackend {
    Folder(Folder),
    Bucket(Box<Bucket>),
}

impl Blobs {
    /// Opens the store in `data/blobs`, staging in `data/staging`, uploads in `data/uploads`, and removes staging folders of dead
    /// processes.
    ///
    /// # Errors
    /// [`BlobError::Io`] or [`BlobError::Store`] if the directories cannot be made or read.
    pub fn open(data: &Path) -> Result<Self, BlobError> {
        let root = data.join("blobs");
        std::fs::create_dir_all(&root)?;
        Self::with(data, |lock| Ok(BlobBackend::Folder(Folder::open(root, lock.to_owned())?)))
    }

    /// Opens the store in a bucket, or a prefix of one, that belongs to the database of `store` alone, with staging as
    /// [`Blobs::open`].
    ///
    /// # Errors
    /// [`BlobError::Bucket`] if it cannot be read and written, [`BlobError::OtherDatabase`], [`BlobError::OtherBucket`], [`BlobError::Index`],
    /// [`BlobError::Io`].
    pub async fn open_bucket(
        data: &Path,
        bucket: Arc<dyn ObjectStore>,
        store: Store,
    ) -> Result<Self, BlobError> {
        let bucket = Bucket::open(bucket, store).await?;
        Self::with(data, |_| Ok(BlobBackend::Bucket(Box::new(bucket))))
    }

    /// As [`Blobs::open_bucket`], but the bucket becomes this database's, whichever had it before: objects that nothing refers to are
    /// collected.
    ///
    /// # Errors
    /// [`BlobError::Bucket`], [`BlobError::Index`], [`BlobError::Io`].
    pub async fn take_over_bucket(
        data: &Path,
        bucket: Arc<dyn ObjectStore>,
        store: Store,
    ) -> Result<Self, BlobError> {
        let bucket = Bucket::take_over(bucket, store).await?;
        Self::with(data, |_| Ok(BlobBackend::Bucket(Box::new(bucket))))
    }

    fn with(
        data: &Path,
        backend: impl FnOnce(&Path) -> Result<BlobBackend, BlobError>,
    ) -> Result<Self, BlobError> {
        let [staging, uploads] = ["staging", "uploads"].map(|name| data.join(name));
        for folder in [&staging, &uploads] {
            std::fs::create_dir_all(folder)?;
        }
        let lock = data.join("blobs.lock");
        let staging_dir = StagingDir::open(&staging, &lock)?;
        Ok(Self(Arc::new(Inner {
            backend: backend(&lock)?,
            data: data.to_owned(),
            staging,
            staging_dir,
            uploads,
            lock,
            request_collection: Notify::new(),
        })))
    }

    /// Starts a blob of at most `limit` bytes.
    pub async fn stage(&self, limit: u64) -> Result<BlobWriter, BlobError> {
        Ok(BlobWriter::new(
            tempfile::Builder::new().prefix("upload-").tempfile_in(self.0.staging_dir.path())?,
            limit,
        ))
    }

    /// Publishes a staged blob; keeps an existing equal one.
    pub async fn publish(&self, staged: &StagedBlob) -> Result<Published, BlobError> {
        match &self.0.backend {
            BlobBackend::Folder(folder) => folder.publish(staged).await,
            BlobBackend::Bucket(bucket) => bucket.publish(staged).await,
        }
    }

    /// Publishes an existing blob again, and returns a file of it; `None` if it does not exist.
    pub async fn republish(&self, blob: BlobRef) -> Result<Option<(Published, BlobCopy)>, BlobError> {
        let published = match &self.0.backend {
            BlobBackend::Folder(folder) => {
                folder.renew(blob).await?.map(|_| Published { blob, created_at: None })
            }
            BlobBackend::Bucket(bucket) => bucket.renew(blob).await?,
        };
        let Some(published) = published else { return Ok(None) };
        Ok(Some((published, self.local_copy(blob.digest).await?)))
    }

    /// Publishes bytes from memory.
    pub async fn put(&self, content: Bytes) -> Result<BlobRef, BlobError> {
        Ok(self.put_new(content).await?.blob)
    }

    /// As [`Blobs::put`], for callers that may undo it ([`Blobs::unpublish`]).
    pub async fn put_new(&self, content: Bytes) -> Result<Published, BlobError> {
        let blob = BlobRef { digest: digest_of(&content).await?, bytes: content.len() as u64 };
        match &self.0.backend {
            BlobBackend::Folder(folder) => {
                if folder.renew(blob).await?.is_some() {
                    return Ok(Published { blob, created_at: None });
                }
                let mut staging = self.stage(blob.bytes).await?;
                for piece in content.chunks(HASHED_AT_ONCE) {
                    staging.write(piece).await?;
                }
                folder.publish(&staging.finish().await?).await
            }
            BlobBackend::Bucket(bucket) => bucket.put(blob, &content).await,
        }
    }

    /// The content of a blob, checked against its digest.
    ///
    /// # Errors
    /// [`BlobError::Missing`], [`BlobError::Damaged`], [`BlobError::Store`] or [`BlobError::Bucket`].
    pub async fn read(&self, digest: Digest) -> Result<Bytes, BlobError> {
        let content = match &self.0.backend {
            // Many times faster than piece by piece.
            BlobBackend::Folder(folder) => {
                folder.store.get(&location(digest)).await.map_err(missing(digest))?.bytes().await?
            }
            BlobBackend::Bucket(bucket) => {
                let pieces = bucket.get(digest, GetOptions::default()).await?;
                pieces.try_collect::<Vec<Bytes>>().await?.concat().into()
            }
        };
        match digest_of(&content).await? {
            actual if actual == digest => Ok(content),
            actual => Err(BlobError::Damaged { expected: digest, actual }),
        }
    }

    /// The blob as a stream that is checked against its digest: one of a damaged blob ends with [`BlobError::Damaged`] before as many bytes
    /// as the blob has. A blob of one piece is checked before this returns.
    ///
    /// # Errors
    /// As [`Blobs::read`], at once or in the stream.
    pub async fn stream_whole(&self, blob: BlobRef) -> Result<Pieces, BlobError> {
        let mut pieces = verified::verified(blob, self.get(blob.digest, GetOptions::default()).await?);
        let first = pieces.try_next().await?;
        Ok(stream::iter(first.map(Ok)).chain(pieces).boxed())
    }

    /// A part of the blob as a stream; `range` must lie within it and not be empty. Only a whole blob can be checked.
    ///
    /// # Errors
    /// As [`Blobs::read`], but for damage.
    pub async fn stream_part(&self, digest: Digest, range: Range<u64>) -> Result<Pieces, BlobError> {
        self.get(digest, GetOptions { range: Some(GetRange::Bounded(range)), ..GetOptions::default() }).await
    }

    async fn get(&self, digest: Digest, options: GetOptions) -> Result<Pieces, BlobError> {
        match &self.0.backend {
            BlobBackend::Folder(folder) => {
                let found =
                    folder.store.get_opts(&location(digest), options).await.map_err(missing(digest))?;
                Ok(found.into_stream().map_err(BlobError::from).boxed())
            }
            BlobBackend::Bucket(bucket) => bucket.get(digest, options).await,
        }
    }

    /// A file with the content of a blob: its own, or a copy of one in a bucket, which is checked against its digest.
    ///
    /// # Errors
    /// As [`Blobs::read`].
    pub async fn local_copy(&self, digest: Digest) -> Result<BlobCopy, BlobError> {
        match &self.0.backend {
            BlobBackend::Folder(folder) => {
                folder.store.head(&location(digest)).await.map_err(missing(digest))?;
                Ok(BlobCopy { path: folder.path(digest)?, _removed: None })
            }
            BlobBackend::Bucket(bucket) => {
                let copy = bucket.download(digest, &self.0.staging_dir).await?;
                Ok(BlobCopy { path: copy.to_path_buf(), _removed: Some(copy) })
            }
        }
    }

    /// Undoes a publication: removes the blob if this publication created it and it was not published since. The caller has made sure
    /// that nothing refers to it. Returns whether it was removed.
    pub async fn unpublish(&self, published: Published) -> Result<bool, BlobError> {
        let (Some(since), digest) = (published.created_at, published.blob.digest) else { return Ok(false) };
        let removed = match &self.0.backend {
            BlobBackend::Folder(folder) => folder.remove_if(digest, move |at| at == since).await?,
            BlobBackend::Bucket(bucket) => bucket.remove(digest, Removable::PublishedAt(since)).await?,
        };
        Ok(removed.is_some())
    }

    /// The blobs that were last published more than `age` before `now`. What died while it removed a blob is finished first.
    ///
    /// # Errors
    /// If nothing can be listed.
    pub async fn older_than(&self, age: SignedDuration, now: Timestamp) -> Result<OldBlobs, BlobError> {
        match &self.0.backend {
            BlobBackend::Folder(folder) => folder.older_than(earlier(now, age)).await,
            // By the database's clock.
            BlobBackend::Bucket(bucket) => {
                Ok(OldBlobs { digests: bucket.older_than(age).await?, error: None })
            }
        }
    }

    /// Removes the blob if it was last published more than `age` before `now`, and returns the bytes freed.
    pub async fn remove_older(
        &self,
        digest: Digest,
        age: SignedDuration,
        now: Timestamp,
    ) -> Result<Option<u64>, BlobError> {
        match &self.0.backend {
            BlobBackend::Folder(folder) => {
                let before = earlier(now, age);
                folder.remove_if(digest, move |at| at < before).await
            }
            BlobBackend::Bucket(bucket) => bucket.remove(digest, Removable::OlderThan(age)).await,
        }
    }

    /// Finishes removals that other processes have begun, and died.
    pub async fn finish_removals(&self) -> Result<(), BlobError> {
        match &self.0.backend {
            BlobBackend::Folder(_) => Ok(()),
            BlobBackend::Bucket(bucket) => bucket.finish_removals().await,
        }
    }

    /// Writes a small file to disk and removes it, to check that blobs can be staged, and asks the bucket, if there is one.
    pub async fn probe(&self) -> Result<(), BlobError> {
        let folder = self.0.staging_dir.path().to_owned();
        blocking(move || {
            let mut file = tempfile::Builder::new().prefix("probe-").tempfile_in(folder)?;
            file.write_all(&[0; PROBE_BYTES])?;
            // Some file systems report a full disk only here.
            file.as_file().sync_data()
        })
        .await?;
        self.check_owner().await
    }

    /// Refuses a bucket that has become another database's.
    ///
    /// # Errors
    /// [`BlobError::OtherDatabase`], [`BlobError::Bucket`].
    pub async fn check_owner(&self) -> Result<(), BlobError> {
        match &self.0.backend {
            BlobBackend::Folder(_) => Ok(()),
            BlobBackend::Bucket(bucket) => bucket.check_owner().await,
        }
    }

    /// Free bytes on the file system of staging, uploads and, unless they are in a bucket, blobs.
    pub fn free_bytes(&self) -> Result<u64, BlobError> {
        Ok(fs4::available_space(&self.0.data)?)
    }

    /// Changing files in the bucket; `None` if blobs are in a folder, where they can be files of their own.
    #[must_use]
    pub fn shared_files(&self) -> Option<SharedFiles> {
        match &self.0.backend {
            BlobBackend::Folder(_) => None,
            BlobBackend::Bucket(bucket) => Some(bucket.shared_files()),
        }
    }

    /// Requests a garbage collection, since blobs may have become unreferenced.
    pub fn request_collection(&self) {
        self.0.request_collection.notify_one();
    }

    /// Waits for [`Blobs::request_collection`].
    pub fn collection_requested(&self) -> Notified<'_> {
        self.0.request_collection.notified()
    }
}

/// Where blobs are, for messages.
impl fmt::Display for Blobs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0.backend {
            BlobBackend::Folder(_) => self.0.data.display().fmt(f),
            BlobBackend::Bucket(_) => f.write_str("the bucket"),
        }
    }
}

/// Runs blocking work on a thread for it.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> Result<T, BlobError> {
    Ok(tokio::task::spawn_blocking(work).await.map_err(io::Error::other)??)
}

/// The digest of content in memory; long content is hashed on a thread for it.
async fn digest_of(content: &Bytes) -> Result<Digest, BlobError> {
    if content.len() <= HASHED_AT_ONCE {
        return Ok(Digest::of(content));
    }
    let content = content.clone();
    blocking(move || Ok(Digest::of(&content))).await
}

fn missing(digest: Digest) -> impl Fn(object_store::Error) -> BlobError {
    move |error| match error {
        object_store::Error::NotFound { .. } => BlobError::Missing(digest),
        error => error.into(),
    }
}

fn location(digest: Digest) -> ObjectPath {
    let hex = digest.to_string();
    ObjectPath::from_iter([ROOT, &hex[..2], &hex[2..4], &hex])
}
