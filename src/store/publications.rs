//! What a bucket has or may have, as the database knows it.
//!
//! A bucket cannot delete an object only if nobody has published it meanwhile, so the database decides. A blob has a row from before its
//! object is made until after it is deleted. A publisher renews the row's time; a row that is marked for removal is renewed by nobody, and
//! only then is the object deleted. Whoever finds a mark of a remover that has died takes it over after a while, far longer than a remover
//! may wait for the bucket.

use jiff::{SignedDuration, Timestamp};

use super::{BlobRef, StoreFuture};
use crate::domain::Digest;

/// How long a remover may wait for the bucket to delete an object.
pub const REMOVAL_LIMIT: SignedDuration = SignedDuration::from_secs(30);

/// Age of a mark for removal that others take over.
pub const REMOVER_IS_DEAD: SignedDuration = SignedDuration::from_secs(120);

/// A publication that was announced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Announcement {
    /// The row, which tells the blob from one of the same content that is published after this one was removed.
    pub(super) row: i64,
    /// Whether nobody else has published it since it was last removed, if ever.
    pub is_new: bool,
    /// When it was announced or last renewed, a time that no other publication of the blob has.
    pub published_at: Timestamp,
}

/// A blob marked for removal, whose object is to be deleted now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Removal {
    /// The row.
    pub(super) row: i64,
    /// The blob.
    pub blob: BlobRef,
}

/// Which publication of a blob may be removed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Removable {
    /// The latest, if it is older than this.
    OlderThan(SignedDuration),
    /// The latest, if it is this one.
    PublishedAt(Timestamp),
}

/// Where a database's blobs are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BlobPlace {
    /// In the data folder.
    Folder,
    /// In a bucket.
    Bucket,
}

impl BlobPlace {
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Folder => "folder",
            Self::Bucket => "bucket",
        }
    }
}

/// Publications of blobs in a bucket, and their removal.
pub trait Publications: Send + Sync + 'static {
    /// Records that a blob is published now; `None` while its object is being deleted.
    fn announce(&self, blob: BlobRef) -> StoreFuture<'_, Option<Announcement>>;

    /// Renews an announced publication, which is not new any more if another publisher has announced or renewed the blob since; `None` if it
    /// was removed since, and has to be announced again.
    fn confirm(&self, announced: Announcement) -> StoreFuture<'_, Option<Announcement>>;

    /// Up to `limit` blobs after `after`, in the order of their digests, that were last published longer ago than `age`.
    fn older_publications(
        &self,
        age: SignedDuration,
        after: Option<Digest>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<Digest>>;

    /// Whether any blob is, or may be, in the bucket.
    fn has_publications(&self) -> StoreFuture<'_, bool>;

    /// Marks a blob for removal; `None` if there is no such publication, or another removes it.
    fn begin_removal(&self, digest: Digest, which: Removable) -> StoreFuture<'_, Option<Removal>>;

    /// Takes over what dead removers have left.
    fn abandoned_removals(&self) -> StoreFuture<'_, Vec<Removal>>;

    /// Forgets a blob whose object is deleted.
    fn end_removal(&self, removal: Removal) -> StoreFuture<'_, ()>;

    /// Decides where the database's blobs are, once and for all, and returns its identity.
    ///
    /// # Errors
    /// [`super::StoreError::BlobsInFolder`] or [`super::StoreError::BlobsInBucket`] if that was decided otherwise.
    fn claim_place(&self, place: BlobPlace) -> StoreFuture<'_, String>;

    /// Decides anew where a copy of a database has its blobs, which are to be published there, and gives the copy an identity of its own,
    /// so that the bucket of the original refuses it.
    fn move_blobs(&self, place: BlobPlace) -> StoreFuture<'_, ()>;
}
