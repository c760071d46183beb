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
mod series;
mod sql;
mod stats;
pub mod uploads;
mod viewers;
mod webhooks;

use futures_util::future::BoxFuture;

pub use accounts::{Accounts, Capacity, Usage};
pub use backup::{BackupError, BackupNote, BucketClaim, DATABASE, back_up, restore};
pub use blobs::{
    BlobCopy, BlobError, BlobSource, BlobState, BlobWriter, Blobs, BucketIndex, BucketUrl, CheckDepth,
    ContentHasher, CopyMode, InvalidBucketUrl, OldBlobs, Published, SharedFiles, StagedBlob, UploadFile,
};
pub use changes::{ChangeKind, Changes};
pub use datasets::{DatasetCreation, DatasetDeletion, DatasetPageKey, DatasetRecord, Datasets, NewDataset};
pub use disk_full::is_disk_full;
pub use error::StoreError;
pub use exports::{ExportRecord, Exports, FileRecord};
pub use fsck::{FsckReport, check as check_data_folder};
pub use idempotency::{Idempotency, IdempotentRequest, PriorRequest};
pub use keys::{KeyChange, KeyProject, KeyRecord, KeyRequest, Keys, NewKey, NewKeyError};
pub use policy::QueuePolicy;
pub use projects::{
    NewProject, ProjectChange, ProjectError, ProjectRecord, ProjectUpdate, ProjectUsage, Projects,
    StoredBytes,
};
pub use publications::BlobPlace;
pub use records::{
    Artifact, ArtifactKind, AttemptOutcome, AttemptRecord, BlobRef, Cancellation, Claim, Deletion, Heartbeat,
    JobFilter, JobRecord, Lease, MAX_QUEUE_POSITION, NewJob, Outcome, PageKey, RetryOutcome, RetryRequest,
    SHOWN_ATTEMPTS, SceneArtifact, WorkerDeath,
};
pub use retention::{RemovedJobs, Retention};
pub use series::Series;
pub use sql::{DatabaseLocation, InvalidDatabaseUrl, PostgresUrl, SchemaChange, SqlStore};
pub use stats::{AttemptCount, Overview, StoreStats};
pub use uploads::{NewUpload, UploadRecord, Uploads};
pub use viewers::{VIEWER_LIFE, ViewerRecord, Viewers};
pub use webhooks::{
    AfterAttempt, DeliveryRecord, DeliveryResult, DeliveryState, DueDelivery, EndpointRecord, NewEndpoint,
    Replay, Webhooks,
};

use jiff::Timestamp;

use crate::domain::{Event, JobId, JobState, Phase, Progress};

/// The result of a store method; boxed so that `dyn Store` is possible.
pub type StoreFuture<'a, T> = BoxFuture<'a, Result<T, StoreError>>;

/// The job table and its queue. Every method is one transaction.
pub trait Store:
    Accounts
    + Exports
    + Idempotency
    + Keys
    + Overview
    + Projects
    + Retention
    + Datasets
    + Series
    + Uploads
    + Viewers
    + Webhooks
    + Send
    + Sync
    + 'static
{
    /// The time by which the store judges deadlines and expiries: the database's, where machines share it.
    fn time(&self) -> StoreFuture<'_, Timestamp>;

    /// Adds a job in state `queued`, with its dataset's blob row, its first event and its request's `Idempotency-Key`.
    ///
    /// # Errors
    /// [`StoreError::IdempotencyKeyUsed`], [`StoreError::QuotaExceeded`], [`StoreError::TooManyJobs`],
    /// [`StoreError::PriorityTooHigh`], [`StoreError::NoDataset`].
    fn create_job(&self, new: NewJob) -> StoreFuture<'_, JobRecord>;

    /// The job.
    fn job(&self, id: JobId) -> StoreFuture<'_, Option<JobRecord>>;

    /// Whether any job is running.
    fn has_running_job(&self) -> StoreFuture<'_, bool>;

    /// Up to `limit` jobs that pass the filter, newest first, older than `before`.
    fn jobs<'a>(
        &'a self,
        filter: &'a JobFilter,
        before: Option<PageKey>,
        limit: u32,
    ) -> StoreFuture<'a, Vec<JobRecord>>;

    /// Up to `limit` events with numbers above `after`, oldest first; `None` if there is no such job.
    fn events(&self, id: JobId, after: u64, limit: u32) -> StoreFuture<'_, Option<Vec<Event>>>;

    /// The number of the newest event of each of these jobs; omits jobs that do not exist.
    fn newest_events<'a>(&'a self, jobs: &'a [JobId]) -> StoreFuture<'a, Vec<(JobId, u64)>>;

    /// Every attempt at the job, oldest first.
    fn attempts(&self, id: JobId) -> StoreFuture<'_, Vec<AttemptRecord>>;

    /// Cancels a queued job at once, or requests that the worker of a running one stop; `None` if there is no such job.
    fn cancel(&self, id: JobId) -> StoreFuture<'_, Option<Cancellation>>;

    /// Queues a new job with the options of this one, which must have failed or been cancelled, for the same project; `None` if there is
    /// no such job. Errors as in [`Store::create_job`].
    fn retry_job(&self, id: JobId, repeat: RetryRequest) -> StoreFuture<'_, Option<RetryOutcome>>;

    /// Deletes a job that has ended, with its events, attempts and references to blobs, if it has the requested version; `None` if there
    /// is no such job.
    fn delete_job(&self, id: JobId, version: Option<u64>) -> StoreFuture<'_, Option<Deletion>>;

    /// Fails queued jobs whose deadline has passed, and counts them. Running ones learn it from [`Store::heartbeat`].
    fn fail_expired(&self) -> StoreFuture<'_, u64>;

    /// Those of the jobs whose checkpoints may still be used: by themselves, by a retry that is queued or running, or by one that is made
    /// within [`QueuePolicy::checkpoint_ttl`] after they failed or were cancelled.
    fn resumable<'a>(&'a self, jobs: &'a [JobId]) -> StoreFuture<'a, Vec<JobId>>;

    /// Grants `worker` a job that is due: of projects that run fewer jobs than they may, those with the highest priority; of these, one of
    /// the project with the fewest running jobs, or of those the one whose latest claim is longest ago; the oldest first. Expires leases first, as [`Store::expire_leases`].
    fn claim<'a>(&'a self, worker: &'a str) -> StoreFuture<'a, Option<Claim>>;

    /// Renews a lease, and returns whether the job is to stop.
    fn heartbeat<'a>(&'a self, lease: &'a Lease) -> StoreFuture<'a, Heartbeat>;

    /// Records the attempt's phase and progress. Every change of phase adds an event; progress at most one per
    /// [`QueuePolicy::progress_event_every`].
    fn report<'a>(&'a self, lease: &'a Lease, phase: Phase, progress: &'a Progress) -> StoreFuture<'a, ()>;

    /// Ends the attempt, and returns the job's new state.
    fn finish<'a>(&'a self, lease: &'a Lease, outcome: Outcome) -> StoreFuture<'a, JobState>;

    /// Ends all attempts of a worker that is known to be dead, and counts them.
    fn expire_worker<'a>(&'a self, worker: &'a str, death: WorkerDeath) -> StoreFuture<'a, u64>;

    /// Ends all attempts whose leases expired under this process's observation, and counts them. To be called often: renewals between two
    /// calls are not observed.
    fn expire_leases(&self) -> StoreFuture<'_, u64>;

    /// Changes of a kind from now on, as far as the database tells of them.
    fn changes(&self, kind: ChangeKind) -> Changes;

    /// One round trip to the database.
    fn ping(&self) -> StoreFuture<'_, ()>;
}
