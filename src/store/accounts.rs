//! Whose bytes fill the disk, and which nobody's are.

use super::{BlobRef, StoreError, StoreFuture};
use crate::domain::{Digest, KeyId};

/// What somebody's things take.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Usage {
    /// Bytes of blobs that scenes and jobs of theirs refer to, each blob counted once.
    pub stored: u64,
    /// Bytes that open uploads of theirs have or will have.
    pub reserved: u64,
}

impl Usage {
    /// What counts against a quota.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.stored.saturating_add(self.reserved)
    }
}

/// What an owner may still store.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Capacity {
    /// What their things take.
    pub usage: Usage,
    /// How much that may be; not bounded if absent.
    pub quota: Option<u64>,
    /// Bytes of the largest dataset among their things. What is longer is none that they have.
    pub largest_dataset: u64,
}

impl Capacity {
    /// Refuses `asked` more bytes, beside `pending` that are about to be stored, if they are over the quota.
    ///
    /// # Errors
    /// [`StoreError::QuotaExceeded`].
    pub fn admit(&self, pending: u64, asked: u64) -> Result<(), StoreError> {
        let used = self.usage.total().saturating_add(pending);
        match self.quota {
            Some(quota) if used.saturating_add(asked) > quota => {
                Err(StoreError::QuotaExceeded { asked, used, quota })
            }
            _ => Ok(()),
        }
    }
}

/// Accounts of the blobs. Every method is one transaction.
pub trait Accounts: Send + Sync + 'static {
    /// What the owner's things take.
    fn usage(&self, owner: Option<KeyId>) -> StoreFuture<'_, Usage>;

    /// What the owner may still store.
    fn capacity(&self, owner: Option<KeyId>) -> StoreFuture<'_, Capacity>;

    /// The dataset with this content, if a scene or a job of the owner's is made of it.
    fn owned_archive(&self, owner: Option<KeyId>, content: Digest) -> StoreFuture<'_, Option<BlobRef>>;

    /// Those of the digests that nothing refers to; what is known of them is forgotten.
    fn forget_blobs<'a>(&'a self, digests: &'a [Digest]) -> StoreFuture<'a, Vec<Digest>>;
}
