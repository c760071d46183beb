//! Shared links.

use jiff::Timestamp;

use crate::domain::{JobId, KeyId, ProjectId, ShareId};

/// Links of a job that may be open at a time.
pub const SHARES_PER_JOB: u32 = 100;

/// A link to be added.
#[derive(Debug, Clone)]
pub struct NewShare {
    /// Its identity, chosen by the caller.
    pub id: ShareId,
    pub job: JobId,
    /// The only thing of the job that it opens, as path and query below the job; `None` for its page and all that it shows.
    pub target: Option<String>,
    /// The key that makes it.
    pub key: Option<KeyId>,
    pub expires_at: Timestamp,
}

/// A link that is open.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ShareRecord {
    pub id: ShareId,
    pub job: JobId,
    /// The job's.
    pub project: ProjectId,
    /// As in [`NewShare::target`].
    pub target: Option<String>,
    pub created_at: Timestamp,
    pub expires_at: Timestamp,
}
