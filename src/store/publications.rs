//! What a bucket has or may have, as the database knows it.
//!
//! A bucket cannot delete an object only if nobody has published it meanwhile, so the database decides. A blob has a row from before its
//! object is made until after it is deleted. A publisher renews the row's time; a row that is marked for removal is renewed by nobody, and
//! only then is the object deleted. Whoever finds a mark of a remover that has died takes it over after a while, far longer than a remover
//! may wait for the bucket.

use jiff::{SignedDuration, Timestamp};

use super::BlobRef;

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
    pub(super) row: i64,
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
