//! Whose bytes fill the disk, and which nobody's are.

use super::Answer;
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

/// Accounts of the blobs. Every method is one transaction.
pub trait Accounts: Send + Sync + 'static {
    /// What the owner's things take.
    fn usage(&self, owner: Option<KeyId>) -> Answer<'_, Usage>;

    /// Those of the digests that nothing refers to; what is known of them is forgotten.
    fn forget_blobs<'a>(&'a self, digests: &'a [Digest]) -> Answer<'a, Vec<Digest>>;
}
