//! Storage and quotas of projects.

use super::StoreError;

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
