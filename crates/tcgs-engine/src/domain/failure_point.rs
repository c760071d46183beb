//! Named points at which a test ends a process on purpose, as a crash would.
//!
//! The code calls [`reach`] where a crash has to leave something that the next process can go on with. What happens there is decided once,
//! by [`plan`]; without a plan, nothing. Builds without debug assertions have no plans, and [`reach`] is empty.

use tcgs_codec::named_choice;

named_choice! {
    /// A point at which a process may be ended.
    pub enum FailurePoint {
        /// A dataset or a result is announced to the database; its object is not in the bucket.
        BlobAnnounced = "blob-announced",
        /// Its object is in the bucket, which the database has not confirmed.
        BlobStored = "blob-stored",
        /// The dataset of a new job is published; the transaction that adds the job is not committed.
        BeforeCreate = "before-create",
        /// A new job is committed; its client has no answer.
        AfterCreate = "after-create",
        /// A job is claimed in a transaction that is not committed.
        BeforeClaim = "before-claim",
        /// A claim is committed; the run has not begun.
        AfterClaim = "after-claim",
        /// An image of the dataset is loaded.
        Ingest = "ingest",
        /// A training step begins.
        Step = "step",
        /// A checkpoint is written under a temporary name.
        BeforeCheckpoint = "before-checkpoint",
        /// A checkpoint has its name.
        AfterCheckpoint = "after-checkpoint",
        /// Training has ended; nothing is encoded.
        BeforeEncode = "before-encode",
        /// The file is encoded and read back; it is not measured.
        AfterEncode = "after-encode",
        /// A result is about to be published as a blob.
        BeforePublish = "before-publish",
        /// It is published.
        AfterPublish = "after-publish",
        /// A job has succeeded in a transaction that is not committed.
        BeforeCommit = "before-commit",
        /// A job's success is committed; its checkpoints are still there.
        AfterCommit = "after-commit",
    }
}

#[cfg(debug_assertions)]
static PLAN: std::sync::OnceLock<fn(FailurePoint)> = std::sync::OnceLock::new();

/// Decides what this process does at every point from now on. The first plan stays.
#[cfg(debug_assertions)]
pub fn plan(at: fn(FailurePoint)) {
    let _ = PLAN.set(at);
}

/// Does what was planned for a point.
#[inline]
pub fn reach(point: FailurePoint) {
    #[cfg(debug_assertions)]
    if let Some(plan) = PLAN.get() {
        plan(point);
    }
    #[cfg(not(debug_assertions))]
    let _ = point;
}
