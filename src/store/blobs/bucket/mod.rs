//! Blobs as objects of an S3 bucket.
//!
//! The database knows which blobs the bucket has or may have, and decides their removal ([`crate::store::publications`]); the bucket itself
//! only keeps bytes. One database uses a bucket, or a prefix of one: an object there names it.

mod marker;
mod request_timeouts;
mod shared_files;
mod upload;
mod url;

use std::{pin::pin, sync::Arc, time::Duration};

use bytes::Bytes;
use futures_util::{StreamExt as _, TryStreamExt as _};
use object_store::{
    GetOptions, ObjectStore, ObjectStoreExt as _, PutMode, PutOptions, PutPayload, path::Path as ObjectPath,
};
use tempfile::TempPath;
use tokio::{
    fs::File,
    io::{AsyncRead, AsyncWriteExt as _},
    time::{sleep, timeout},
};

pub use shared_files::SharedFiles;
pub(super) use upload::BucketUpload;
pub use url::{BucketUrl, InvalidBucketUrl};

use super::{
    BlobError, ContentHasher, Pieces, Published, ROOT, StagedBlob, location,
    parts::{PART_BYTES, write_parts},
    staging_dir::StagingDir,
};
use crate::{
    domain::{Digest, FailurePoint, failure_point::reach},
    store::{
        BlobPlace, BlobRef, Store,
        publications::{Announcement, REMOVAL_LIMIT, Removable, Removal},
    },
};

/// Time between two renewals of a publication whose content is still on its way.
const RENEW_EVERY: Duration = Duration::from_secs(60);

/// Time between two looks at a blob that another process removes.
const WHILE_REMOVED: Duration = Duration::from_millis(100);

/// Blobs looked up at a time.
const BATCH: u32 = 500;

/// The bucket.
#[derive(Clone)]
pub(super) struct Bucket {
    objects: Arc<dyn ObjectStore>,
    store: Store,
    identity: Arc<str>,
}

/// Content to be put.
enum BlobContent<'a> {
    Staged(&'a StagedBlob),
    Memory(&'a Bytes),
}

impl Bucket {
    /// Takes the bucket for the database of `store`.
    pub(super) async fn open(objects: Arc<dyn ObjectStore>, store: Store) -> Result<Self, BlobError> {
        let identity = store.claim_place(BlobPlace::Bucket).await?;
        // A database that has blobs has a bucket: another one, named by mistake, would be taken for it and lack all of them.
        if store.has_publications().await? {
            marker::expect(&*objects, &identity).await?;
        } else {
            marker::claim(&*objects, &identity).await?;
        }
        Ok(Self { objects, store, identity: identity.into() })
    }

    /// Takes the bucket for the database of `store`, whichever had it before, with everything in it.
    pub(super) async fn take_over(objects: Arc<dyn ObjectStore>, store: Store) -> Result<Self, BlobError> {
        let identity = store.claim_place(BlobPlace::Bucket).await?;
        marker::replace(&*objects, &identity).await?;
        let bucket = Self { objects, store, identity: identity.into() };
        bucket.announce_objects().await?;
        Ok(bucket)
    }

    /// Announces every object, so that those that nothing refers to are collected.
    async fn announce_objects(&self) -> Result<(), BlobError> {
        let mut listed = self.objects.list(Some(&ObjectPath::from(ROOT)));
        while let Some(object) = listed.try_next().await.map_err(BlobError::Bucket)? {
            if let Some(digest) = object.location.filename().and_then(|name| name.parse().ok()) {
                self.announce(BlobRef { digest, bytes: object.size }).await?;
            }
        }
        Ok(())
    }

    /// Changing files beside the blobs.
    pub(super) fn shared_files(&self) -> SharedFiles {
        SharedFiles(Arc::clone(&self.objects))
    }

    /// Whether the bucket answers, and is still this database's.
    pub(super) async fn check_owner(&self) -> Result<(), BlobError> {
        marker::check(&*self.objects, &self.identity).await
    }

    pub(super) async fn publish(&self, staged: &StagedBlob) -> Result<Published, BlobError> {
        self.publish_content(staged.blob(), BlobContent::Staged(staged)).await
    }

    pub(super) async fn put(&self, blob: BlobRef, content: &Bytes) -> Result<Published, BlobError> {
        self.publish_content(blob, BlobContent::Memory(content)).await
    }

    /// Publishes a blob again that is there; `None` if it is not.
    pub(super) async fn renew(&self, blob: BlobRef) -> Result<Option<Published>, BlobError> {
        loop {
            let announced = self.announce(blob).await?;
            if !self.has(blob).await? {
                return Ok(None);
            }
            if self.store.confirm(announced).await?.is_some() {
                return Ok(Some(Published { blob, created_at: None }));
            }
        }
    }

    async fn publish_content(&self, blob: BlobRef, content: BlobContent<'_>) -> Result<Published, BlobError> {
        loop {
            let mut announced = self.announce(blob).await?;
            reach(FailurePoint::BlobAnnounced);
            if !self.has(blob).await? {
                self.put_content(blob, &content, &mut announced).await?;
            }
            reach(FailurePoint::BlobStored);
            // Also if it was there: whoever may withdraw an earlier publication learns of this one.
            if let Some(confirmed) = self.store.confirm(announced).await? {
                // Only then is no other publisher left without the object if this publication is withdrawn.
                let created_at = confirmed.is_new.then_some(confirmed.published_at);
                return Ok(Published { blob, created_at });
            }
        }
    }

    /// Announces a publication, once nobody removes the blob.
    async fn announce(&self, blob: BlobRef) -> Result<Announcement, BlobError> {
        loop {
            if let Some(announced) = self.store.announce(blob).await? {
                return Ok(announced);
            }
            sleep(WHILE_REMOVED).await;
        }
    }

    /// Whether there is such an object of the blob's length.
    async fn has(&self, blob: BlobRef) -> Result<bool, BlobError> {
        Ok(self.length(blob.digest).await? == Some(blob.bytes))
    }

    /// The length of a blob's object, if there is one.
    pub(super) async fn length(&self, digest: Digest) -> Result<Option<u64>, BlobError> {
        match self.objects.head(&location(digest)).await {
            Ok(object) => Ok(Some(object.size)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(BlobError::Bucket(error)),
        }
    }

    async fn put_content(
        &self,
        blob: BlobRef,
        content: &BlobContent<'_>,
        announced: &mut Announcement,
    ) -> Result<(), BlobError> {
        let is_small = blob.bytes <= PART_BYTES as u64;
        match content {
            BlobContent::Memory(content) if is_small => self.put_small(blob, (*content).clone()).await,
            BlobContent::Memory(content) => self.put_parts(blob, &content[..], announced).await,
            BlobContent::Staged(staged) if is_small => {
                self.put_small(blob, tokio::fs::read(staged.path()).await?.into()).await
            }
            BlobContent::Staged(staged) => {
                self.put_parts(blob, File::open(staged.path()).await?, announced).await
            }
        }
    }

    /// Puts content in one request. An object of another length under its name is damaged, and replaced.
    async fn put_small(&self, blob: BlobRef, content: Bytes) -> Result<(), BlobError> {
        let at = location(blob.digest);
        let payload = PutPayload::from(content);
        let create = PutOptions::from(PutMode::Create);
        match self.objects.put_opts(&at, payload.clone(), create).await {
            Ok(_) => Ok(()),
            // Another publisher was faster.
            Err(object_store::Error::AlreadyExists { .. }) if self.has(blob).await? => Ok(()),
            Err(object_store::Error::AlreadyExists { .. }) => {
                self.objects.put(&at, payload).await.map(drop).map_err(BlobError::Bucket)
            }
            Err(error) => Err(BlobError::Bucket(error)),
        }
    }

    /// Puts content in parts, and renews its publication meanwhile.
    async fn put_parts(
        &self,
        blob: BlobRef,
        content: impl AsyncRead + Unpin + Send,
        announced: &mut Announcement,
    ) -> Result<(), BlobError> {
        let at = location(blob.digest);
        let mut writing = pin!(write_parts(&*self.objects, &at, content, blob.bytes, BlobError::Bucket));
        loop {
            tokio::select! {
                written = &mut writing => return written,
                () = sleep(RENEW_EVERY) => {
                    // If it was removed, or the database is away, that shows at the end.
                    if let Ok(Some(renewed)) = self.store.confirm(*announced).await {
                        *announced = renewed;
                    }
                }
            }
        }
    }

    /// The content of a blob, from which the caller takes the part it wants.
    pub(super) async fn get(&self, digest: Digest, options: GetOptions) -> Result<Pieces, BlobError> {
        match self.objects.get_opts(&location(digest), options).await {
            Ok(found) => Ok(found.into_stream().map_err(BlobError::Bucket).boxed()),
            Err(object_store::Error::NotFound { .. }) => Err(BlobError::Missing(digest)),
            Err(error) => Err(BlobError::Bucket(error)),
        }
    }

    /// A copy of a blob in a private file, checked against its digest.
    pub(super) async fn download(&self, digest: Digest, staging: &StagingDir) -> Result<TempPath, BlobError> {
        let mut content = self.get(digest, GetOptions::default()).await?;
        let file = tempfile::Builder::new().prefix("copy-").tempfile_in(staging.path())?;
        let (file, path) = file.into_parts();
        let (mut file, mut hasher) = (File::from_std(file), ContentHasher::new(u64::MAX));
        while let Some(piece) = content.try_next().await? {
            hasher.update(&piece)?;
            file.write_all(&piece).await?;
        }
        file.flush().await?;
        match hasher.finish().digest {
            actual if actual == digest => Ok(path),
            actual => Err(BlobError::Damaged { expected: digest, actual }),
        }
    }

    /// The blobs that were last published longer than `age` ago.
    pub(super) async fn older_than(&self, age: jiff::SignedDuration) -> Result<Vec<Digest>, BlobError> {
        let mut found: Vec<Digest> = Vec::new();
        loop {
            let page = self.store.older_publications(age, found.last().copied(), BATCH).await?;
            if page.is_empty() {
                return Ok(found);
            }
            found.extend(page);
        }
    }

    /// Removes the blob if `which` accepts its latest publication, and returns the bytes freed.
    pub(super) async fn remove(&self, digest: Digest, which: Removable) -> Result<Option<u64>, BlobError> {
        let Some(removal) = self.store.begin_removal(digest, which).await? else { return Ok(None) };
        self.finish_removal(removal).await?;
        Ok(Some(removal.blob.bytes))
    }

    /// Finishes what removers have begun that died.
    ///
    /// # Errors
    /// The first, after all others are finished.
    pub(super) async fn finish_removals(&self) -> Result<(), BlobError> {
        let mut finished = Ok(());
        for removal in self.store.abandoned_removals().await? {
            // One that fails leaves the others to be finished.
            finished = finished.and(self.finish_removal(removal).await);
        }
        finished
    }

    async fn finish_removal(&self, removal: Removal) -> Result<(), BlobError> {
        match timeout(REMOVAL_LIMIT.unsigned_abs(), self.delete(removal.blob.digest)).await {
            Ok(deleted) => deleted?,
            // Whether it is deleted is unknown; the next collection finishes it.
            Err(late) => return Err(BlobError::Io(late.into())),
        }
        Ok(self.store.end_removal(removal).await?)
    }

    /// Deletes a blob's object, if there is one.
    pub(super) async fn delete(&self, digest: Digest) -> Result<(), BlobError> {
        match self.objects.delete(&location(digest)).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(BlobError::Bucket(error)),
        }
    }
}

impl std::fmt::Debug for Bucket {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Bucket").field(&self.objects).finish_non_exhaustive()
    }
}
