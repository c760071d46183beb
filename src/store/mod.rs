//! Persistent state: datasets, uploads, jobs with their attempts and events, keys, webhooks, and the blobs that they refer to.
//!
//! SQL and object storage are used here only. Invariants:
//!
//! - **At-least-once execution, exactly-once publication.** A job may run more than once; the artifacts of
//!   exactly one attempt are ever linked to it.
//! - **Fencing.** A claim increments the job's attempt number, and every write of a worker names its attempt. If that is no longer
//!   current, nothing is written and the worker gets [`StoreError::LeaseLost`].
//! - **Leases.** An attempt ends when a supervisor saw its worker die, or a process observed no renewal for the length of a lease.
//!   The wall clock has no influence on that.
//! - **Events** of a job are numbered from 1 without gaps; each is written in the transaction of the change that it records.
//! - **Outbox.** Webhook deliveries are written in the transaction of the job's change of state.
//! - **Cancellation against completion.** Whichever transaction commits first decides. A job whose cancellation was accepted while it
//!   ran never becomes `succeeded`.

mod accounts;
mod backup;
pub mod blobs;
mod changes;
mod datasets;
mod disk_full;
mod error;
mod exports;
mod finished_runs;
mod fsck;
pub mod garbage;
mod idempotency;
mod keys;
mod leases;
mod policy;
mod projects;
pub mod publications;
mod records;
pub mod retention;
mod retry;
mod sessions;
mod shares;
mod sql;
mod stats;
pub mod uploads;
mod viewers;
mod webhooks;
mod workers;

pub use accounts::{Capacity, Usage};
pub use backup::{BackupError, BackupNote, BucketClaim, DATABASE, back_up, restore};
pub use blobs::{
    BlobCopy, BlobError, BlobSource, BlobState, BlobWriter, Blobs, BucketUrl, CheckDepth, ContentHasher,
    CopyMode, InvalidBucketUrl, OldBlobs, Published, SharedFiles, StagedBlob, UploadFile,
};
pub use changes::{ChangeKind, Changes};
pub use datasets::{DatasetCreation, DatasetDeletion, DatasetPageKey, DatasetRecord, NewDataset};
pub use disk_full::is_disk_full;
pub use error::StoreError;
pub use exports::{ExportRecord, FileRecord};
pub use finished_runs::{FinishedRun, RUNS_LOOKED_AT};
pub use fsck::{FsckReport, check as check_data_folder};
pub use idempotency::{IdempotentRequest, PriorRequest};
pub use keys::{KeyChange, KeyProject, KeyRecord, KeyRequest, NewKey, NewKeyError};
pub use policy::QueuePolicy;
pub use projects::{
    NewProject, ProjectChange, ProjectError, ProjectRecord, ProjectUpdate, ProjectUsage, StoredBytes,
};
pub use publications::BlobPlace;
pub use records::{
    Artifact, ArtifactKind, AttemptOutcome, AttemptRecord, BlobRef, Cancellation, Claim, Deletion, Heartbeat,
    JobChange, JobDataset, JobFilter, JobRecord, JobUpdate, JobVersion, Lease, MAX_QUEUE_POSITION, NewJob,
    Outcome, PageKey, RemovedJobs, RetryOutcome, RetryRequest, SHOWN_ATTEMPTS, SceneArtifact, WorkerDeath,
};
pub use sessions::{NewSession, SESSIONS_PER_KEY};
pub use shares::{NewShare, SHARES_PER_JOB, ShareRecord};
pub use sql::{DatabaseLocation, InvalidDatabaseUrl, PostgresUrl, SchemaChange, Store};
#[doc(hidden)]
pub use sql::{StoreFaults, migrations};
pub use stats::{AttemptCount, StoreStats};
pub use uploads::{NewUpload, UploadRecord};
pub use viewers::{VIEWER_LIFE, ViewerRecord};
pub use webhooks::{
    AfterAttempt, DeliveryRecord, DeliveryResult, DeliveryState, DueDelivery, EndpointRecord, MAX_PAUSE,
    NewEndpoint, Replay,
};
pub use workers::{Claimant, WORKER_LIFE};

use futures_util::future::BoxFuture;
use jiff::{SignedDuration, Timestamp};

/// The result of a method of [`Store`]; boxed so that callers compile without the types of its queries.
pub type StoreFuture<'a, T> = BoxFuture<'a, Result<T, StoreError>>;

/// The time `by` before `now`.
fn earlier(now: Timestamp, by: SignedDuration) -> Timestamp {
    now.checked_sub(by).unwrap_or(Timestamp::MIN)
}
