//! Blobs named by the SHA-256 of their content, kept through `object_store` in a local directory.
//!
//! A blob is staged (streamed to a private file while it is hashed and counted), then published under
//! `sha256/ab/cd/<digest>` in one atomic step with its bytes and directory entries flushed to disk. A published
//! blob is complete, never changes, and publishing it again changes nothing. A crash in between leaves a staging file or
//! an unreferenced blob, never a partial one.
//!
//! The modification time of a blob's file is its latest publication. Only blobs older than a grace time are removed, so a publisher
//! has that long to add a reference.

mod age;
mod check;
mod files;
mod staging;
mod staging_dir;
mod upload;

use std::{
    io::{self, Write as _},
    ops::Range,
    path::{Path, PathBuf},
    sync::Arc,
};

use bytes::Bytes;
use futures_util::{StreamExt as _, TryStreamExt as _, stream::BoxStream};
use jiff::Timestamp;
use object_store::{
    GetOptions, GetRange, ObjectStore as _, ObjectStoreExt as _, WriteMultipart, local::LocalFileSystem,
    path::Path as ObjectPath,
};
use thiserror::Error;
use tokio::{
    fs::File,
    io::AsyncReadExt as _,
    sync::{Notify, futures::Notified},
};

pub use check::{BlobState, CheckDepth, CopyMode};
pub use staging::{BlobWriter, ContentHasher, StagedBlob};
use staging_dir::StagingDir;
pub use upload::UploadFile;

use super::{BlobRef, is_disk_full};
use crate::domain::{Digest, UploadId};

const PART_BYTES: usize = 8 << 20;
const PARTS_IN_FLIGHT: usize = 2;
/// Common block size of file systems.
const PROBE_BYTES: usize = 4096;

/// An error of the blob store.
#[derive(Debug, Error)]
pub enum BlobError {
    /// More bytes than the limit.
    #[error("the content is longer than the limit of {limit} bytes")]
    TooLarge {
        /// The limit.
        limit: u64,
    },
    /// There is no such blob.
    #[error("there is no blob {0}")]
    Missing(Digest),
    /// Bytes of an upload that were on disk are missing.
    #[error("upload {id} has {found} bytes on disk instead of {expected}")]
    UploadDamaged {
        /// The upload.
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
    /// An I/O error.
    #[error("a file of the blob store cannot be read or written")]
    Io(#[from] io::Error),
    /// The object store failed.
    #[error("the object store failed")]
    Store(#[from] object_store::Error),
}

impl BlobError {
    /// Whether the disk is full.
    #[must_use]
    pub fn is_disk_full(&self) -> bool {
        is_disk_full(self)
    }
}

/// A published blob.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Published {
    /// The blob.
    pub blob: BlobRef,
    /// Its modification time if this publication created it.
    created_at: Option<Timestamp>,
}

/// The blob store; clones share it.
#[derive(Debug, Clone)]
pub struct Blobs(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    store: LocalFileSystem,
    /// Folder of blobs; staging and uploads are beside it, on the same file system.
    root: PathBuf,
    staging: PathBuf,
    /// This process's folder in `staging`.
    staging_dir: StagingDir,
    uploads: PathBuf,
    /// Lock file that guards the ages of blobs among all processes with this store.
    lock: PathBuf,
    request_collection: Notify,
}

impl Blobs {
    /// Opens the store in `data/blobs`, staging in `data/staging`, uploads in `data/uploads`, and removes staging folders of dead
    /// processes.
    ///
    /// # Errors
    /// [`BlobError::Io`] or [`BlobError::Store`] if the directories cannot be made or read.
    pub fn open(data: &Path) -> Result<Self, BlobError> {
        let [root, staging, uploads] = ["blobs", "staging", "uploads"].map(|name| data.join(name));
        for folder in [&root, &staging, &uploads] {
            std::fs::create_dir_all(folder)?;
        }
        let lock = data.join("blobs.lock");
        let staging_dir = StagingDir::open(&staging, &lock)?;
        let store = LocalFileSystem::new_with_prefix(&root)?.with_fsync(true);
        Ok(Self(Arc::new(Inner {
            store,
            root,
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

    /// Publishes a staged blob; keeps an existing equal one. Writes no copy if the file system has hard links.
    pub async fn publish(&self, staged: &StagedBlob) -> Result<Published, BlobError> {
        let blob = staged.blob();
        if self.renew(blob).await?.is_some() {
            return Ok(Published { blob, created_at: None });
        }
        if let Some(published) = self.link(staged).await? {
            return Ok(published);
        }
        self.copy(staged).await?;
        Ok(Published { blob, created_at: self.renew(blob).await? })
    }

    async fn copy(&self, staged: &StagedBlob) -> Result<(), BlobError> {
        let mut file = File::open(staged.path()).await?;
        let upload = self.0.store.put_multipart(&location(staged.blob().digest)).await?;
        let mut writer = WriteMultipart::new_with_chunk_size(upload, PART_BYTES);
        let copied: Result<(), BlobError> = async {
            let mut buffer = vec![0; 1 << 20];
            loop {
                let count = file.read(&mut buffer).await?;
                if count == 0 {
                    return Ok(());
                }
                writer.wait_for_capacity(PARTS_IN_FLIGHT).await?;
                writer.write(&buffer[..count]);
            }
        }
        .await;
        if let Err(error) = copied {
            // The copy's own error is the one to report.
            let _ = writer.abort().await;
            return Err(error);
        }
        writer.finish().await?;
        Ok(())
    }

    /// Publishes an existing blob again, and returns its file; `None` if it does not exist.
    pub async fn republish(&self, blob: BlobRef) -> Result<Option<(Published, PathBuf)>, BlobError> {
        if self.renew(blob).await?.is_none() {
            return Ok(None);
        }
        let path = self.0.store.path_to_filesystem(&location(blob.digest))?;
        Ok(Some((Published { blob, created_at: None }, path)))
    }

    /// Publishes bytes from memory.
    pub async fn put(&self, content: Bytes) -> Result<BlobRef, BlobError> {
        Ok(self.put_new(content).await?.blob)
    }

    /// As [`Blobs::put`], for callers that may undo it ([`Blobs::unpublish`]).
    pub async fn put_new(&self, content: Bytes) -> Result<Published, BlobError> {
        let blob = BlobRef { digest: Digest::of(&content), bytes: content.len() as u64 };
        if self.renew(blob).await?.is_some() {
            return Ok(Published { blob, created_at: None });
        }
        self.0.store.put(&location(blob.digest), content.into()).await?;
        Ok(Published { blob, created_at: self.renew(blob).await? })
    }

    /// The content of a blob, checked against its digest.
    ///
    /// # Errors
    /// [`BlobError::Missing`], [`BlobError::Damaged`] or [`BlobError::Store`].
    pub async fn read(&self, digest: Digest) -> Result<Bytes, BlobError> {
        let content = self.0.store.get(&location(digest)).await.map_err(missing(digest))?.bytes().await?;
        match Digest::of(&content) {
            actual if actual == digest => Ok(content),
            actual => Err(BlobError::Damaged { expected: digest, actual }),
        }
    }

    /// A part of the blob as a stream; `range` must lie within it and not be empty.
    ///
    /// # Errors
    /// [`BlobError::Missing`] or [`BlobError::Store`].
    pub async fn stream(
        &self,
        digest: Digest,
        range: Range<u64>,
    ) -> Result<BoxStream<'static, Result<Bytes, BlobError>>, BlobError> {
        let options = GetOptions { range: Some(GetRange::Bounded(range)), ..GetOptions::default() };
        let result = self.0.store.get_opts(&location(digest), options).await.map_err(missing(digest))?;
        Ok(result.into_stream().map_err(BlobError::from).boxed())
    }

    /// The blob's own file; it must not be written.
    ///
    /// # Errors
    /// [`BlobError::Missing`] or [`BlobError::Store`].
    pub async fn local_file(&self, digest: Digest) -> Result<PathBuf, BlobError> {
        let location = location(digest);
        self.0.store.head(&location).await.map_err(missing(digest))?;
        Ok(self.0.store.path_to_filesystem(&location)?)
    }

    /// Writes a small file to disk and removes it, to check that blobs can be written.
    pub async fn probe(&self) -> Result<(), BlobError> {
        let folder = self.0.staging_dir.path().to_owned();
        blocking(move || {
            let mut file = tempfile::Builder::new().prefix("probe-").tempfile_in(folder)?;
            file.write_all(&[0; PROBE_BYTES])?;
            // Some file systems report a full disk only here.
            file.as_file().sync_data()
        })
        .await
    }

    /// Free bytes on the file system of blobs and uploads.
    pub fn free_bytes(&self) -> Result<u64, BlobError> {
        Ok(fs4::available_space(&self.0.root)?)
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

/// Runs blocking work on a thread for it.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> Result<T, BlobError> {
    Ok(tokio::task::spawn_blocking(work).await.map_err(io::Error::other)??)
}

fn missing(digest: Digest) -> impl Fn(object_store::Error) -> BlobError {
    move |error| match error {
        object_store::Error::NotFound { .. } => BlobError::Missing(digest),
        error => error.into(),
    }
}

fn location(digest: Digest) -> ObjectPath {
    let hex = digest.to_string();
    ObjectPath::from_iter(["sha256", &hex[..2], &hex[2..4], &hex])
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn staged(blobs: &Blobs, content: &[u8]) -> StagedBlob {
        let mut staging = blobs.stage(1 << 30).await.expect("room");
        for piece in content.chunks(3) {
            staging.write(piece).await.expect("a write");
        }
        staging.finish().await.expect("an end")
    }

    #[tokio::test]
    async fn a_published_blob_reads_back_whole_and_in_parts() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        let upload = staged(&blobs, b"twelve bytes").await;
        let blob = blobs.publish(&upload).await.expect("published");
        let blob = blob.blob;
        assert_eq!(blob, BlobRef { digest: Digest::of(b"twelve bytes"), bytes: 12 });
        assert_eq!(blobs.publish(&upload).await.expect("published again").blob, blob);
        assert_eq!(blobs.put(Bytes::from_static(b"twelve bytes")).await.expect("the same"), blob);
        assert_eq!(&blobs.read(blob.digest).await.expect("whole")[..], b"twelve bytes");
        let part: Vec<Bytes> =
            blobs.stream(blob.digest, 7..12).await.expect("part").try_collect().await.expect("bytes");
        assert_eq!(part.concat(), b"bytes");
        let file = blobs.local_file(blob.digest).await.expect("a file");
        assert_eq!(std::fs::read(file).expect("readable"), b"twelve bytes");
        let path = upload.path().to_owned();
        drop(upload);
        assert!(!path.exists(), "a staging file must not outlive its handle");
    }

    #[cfg(unix)]
    #[tokio::test]
    async fn a_staged_file_becomes_a_blob_without_a_copy() {
        use std::os::unix::fs::MetadataExt as _;

        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        let upload = staged(&blobs, b"twelve bytes").await;
        let staged_as = std::fs::metadata(upload.path()).expect("there").ino();
        let blob = blobs.publish(&upload).await.expect("published").blob;
        drop(upload);
        let path = blobs.local_file(blob.digest).await.expect("a file");
        let metadata = std::fs::metadata(path).expect("there");
        assert_eq!((metadata.ino(), metadata.nlink()), (staged_as, 1), "one file, now by its own name alone");
    }

    #[tokio::test]
    async fn a_publication_is_undone_only_if_it_created_the_blob_and_none_followed() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        let is_there = async |published: Published| blobs.local_file(published.blob.digest).await.is_ok();
        let content = Bytes::from_static(b"twelve bytes");
        let put = blobs.put_new(content.clone()).await.expect("published");
        assert!(blobs.unpublish(put).await.expect("asked") && !is_there(put).await);
        assert!(!blobs.unpublish(put).await.expect("asked"), "it is gone");

        let upload = staged(&blobs, &content).await;
        let first = blobs.publish(&upload).await.expect("published");
        let second = blobs.put_new(content.clone()).await.expect("published again");
        assert!(!blobs.unpublish(first).await.expect("asked"), "another counts on it");
        assert!(!blobs.unpublish(second).await.expect("asked"), "it was there before");
        assert!(is_there(first).await);
        let again = blobs.republish(first.blob).await.expect("asked").expect("there");
        assert_eq!(std::fs::read(again.1).expect("readable"), &content[..]);
        let absent = BlobRef { digest: Digest::of(b"absent"), bytes: 6 };
        assert!(blobs.republish(absent).await.expect("asked").is_none());
    }

    #[tokio::test]
    async fn content_that_is_not_kept_is_hashed_too() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        let mut staging = blobs.stage(1 << 30).await.expect("room");
        staging.write(b"twelve").await.expect("a write");
        let files = || std::fs::read_dir(blobs.0.staging_dir.path()).expect("a folder").count();
        let before = files();
        let mut content = staging.into_hasher(12).await.expect("forgotten");
        assert_eq!(files(), before - 1);
        content.update(b" bytes").expect("as long as may be");
        assert!(matches!(content.update(b"!"), Err(BlobError::TooLarge { limit: 12 })));
        let mut content = ContentHasher::new(12);
        content.update(b"twelve bytes").expect("as long as may be");
        assert_eq!(content.finish(), BlobRef { digest: Digest::of(b"twelve bytes"), bytes: 12 });
    }

    #[tokio::test]
    async fn limits_damage_and_absence_are_different_errors() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        let mut staging = blobs.stage(4).await.expect("room");
        staging.write(b"four").await.expect("exactly the limit");
        assert!(matches!(staging.write(b"!").await, Err(BlobError::TooLarge { limit: 4 })));
        let absent = Digest::of(b"absent");
        assert!(matches!(blobs.read(absent).await, Err(BlobError::Missing(digest)) if digest == absent));
        assert!(matches!(blobs.local_file(absent).await, Err(BlobError::Missing(_))));
        let blob = blobs.put(Bytes::from_static(b"sound")).await.expect("published");
        let file = blobs.local_file(blob.digest).await.expect("a file");
        std::fs::write(file, b"rotten").expect("writable");
        assert!(matches!(blobs.read(blob.digest).await, Err(BlobError::Damaged { .. })));
        assert!(blobs.free_bytes().expect("known") > 0);
    }

    #[tokio::test]
    async fn an_upload_resumes_after_the_received_bytes_and_becomes_a_blob_without_a_copy() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        let id = UploadId(uuid::Uuid::from_u128(1));
        let mut file = blobs.open_upload(id).await.expect("opens").expect("free");
        file.write(b"twelve ").await.expect("a write");
        file.sync().await.expect("on disk");
        file.write(b"and what the table never heard of").await.expect("a write");
        file.sync().await.expect("on disk");
        drop(file);
        assert_eq!(blobs.uploads().await.expect("a list"), [id]);
        let mut file = blobs.open_upload(id).await.expect("opens").expect("free");
        assert!(matches!(
            file.continue_at(41).await,
            Err(BlobError::UploadDamaged { expected: 41, found: 40, .. })
        ));
        file.continue_at(7).await.expect("at the end of what was received");
        file.write(b"bytes").await.expect("a write");
        file.sync().await.expect("on disk");
        drop(file);
        let reopen = || async { blobs.open_upload(id).await.expect("opens").expect("free") };
        assert!(matches!(reopen().await.finish(13).await, Err(BlobError::UploadDamaged { found: 12, .. })));
        let staged = reopen().await.finish(12).await.expect("whole");
        assert!(blobs.open_upload(id).await.expect("asked").is_none(), "nobody writes while it is used");
        let blob = blobs.publish(&staged).await.expect("published").blob;
        assert_eq!(&blobs.read(blob.digest).await.expect("whole")[..], b"twelve bytes");
        #[cfg(unix)]
        {
            use std::os::unix::fs::MetadataExt as _;
            let path = blobs.local_file(blob.digest).await.expect("a file");
            let [one, other] = [&path, staged.path()].map(|path| std::fs::metadata(path).expect("there"));
            assert_eq!(one.ino(), other.ino());
        }
        assert!(!blobs.remove_upload(id).await.expect("asked"), "it is held");
        drop(staged);
        assert!(blobs.remove_upload(id).await.expect("asked"));
        assert!(blobs.remove_upload(id).await.expect("asked"), "what is gone is gone");
        assert_eq!(&blobs.read(blob.digest).await.expect("the blob stays")[..], b"twelve bytes");
    }

    #[tokio::test]
    async fn an_upload_has_one_writer_at_a_time() {
        let folder = tempfile::tempdir().expect("a folder");
        // As two processes would.
        let [one, other] = [(); 2].map(|()| Blobs::open(folder.path()).expect("a store"));
        let id = UploadId(uuid::Uuid::from_u128(1));
        let writer = one.open_upload(id).await.expect("opens").expect("free");
        for blobs in [&one, &other] {
            assert!(blobs.open_upload(id).await.expect("asked").is_none());
        }
        let writing = tokio::spawn(async move {
            let _writer = writer;
            std::future::pending::<()>().await;
        });
        writing.abort();
        assert!(writing.await.expect_err("it died").is_cancelled());
        assert!(other.open_upload(id).await.expect("asked").is_some());
    }
}
