//! Storage and quotas of projects, and unreferenced blobs.

use super::{BlobRef, StoreError, StoreFuture};
use crate::domain::{Digest, ProjectId};

/// Bytes that a project uses.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Usage {
    /// Bytes of blobs that the project's datasets and jobs refer to, each blob counted once.
    pub stored: u64,
    /// Total length of the project's open uploads.
    pub reserved: u64,
}

impl Usage {
    /// Bytes that count against the quota.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.stored.saturating_add(self.reserved)
    }
}

/// A project's usage and quota.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Capacity {
    /// Bytes in use.
    pub usage: Usage,
    /// The quota; unlimited if absent.
    pub quota: Option<u64>,
}

impl Capacity {
    /// Refuses `requested` more bytes, beside `pending` that are being stored, if they are over the quota.
    ///
    /// # Errors
    /// [`StoreError::QuotaExceeded`].
    pub fn admit(&self, pending: u64, requested: u64) -> Result<(), StoreError> {
        let used = self.usage.total().saturating_add(pending);
        match self.quota {
            Some(quota) if used.saturating_add(requested) > quota => {
                Err(StoreError::QuotaExceeded { requested, used, quota })
            }
            _ => Ok(()),
        }
    }
}

/// The part of a store that accounts for blobs. Every method is one transaction.
pub trait Accounts: Send + Sync + 'static {
    /// The project's storage.
    fn usage(&self, project: ProjectId) -> StoreFuture<'_, Usage>;

    /// The project's storage and quota.
    fn capacity(&self, project: ProjectId) -> StoreFuture<'_, Capacity>;

    /// Bytes of the project's largest dataset, 0 if it has none; a longer upload cannot be one that the project has. Reads all blobs of the
    /// project.
    fn largest_dataset(&self, project: ProjectId) -> StoreFuture<'_, u64>;

    /// The blob with this content, if something of the project refers to it.
    fn owned_archive(&self, project: ProjectId, content: Digest) -> StoreFuture<'_, Option<BlobRef>>;

    /// Removes the rows of those blobs that nothing refers to, and returns their digests.
    fn forget_blobs<'a>(&'a self, digests: &'a [Digest]) -> StoreFuture<'a, Vec<Digest>>;
}
