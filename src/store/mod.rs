//! Everything that outlives a process: scenes, uploads, jobs with their attempts and events, and the blobs that they refer to.
//!
//! SQL and object storage live here and nowhere else. What always holds:
//!
//! - **At-least-once execution, exactly-once publication.** A job may run more than once; the artifacts of
//!   exactly one attempt are ever linked to it.
//! - **Fence.** A claim raises the job's attempt number, and every write of a worker names the attempt that it
//!   was given. If the job has moved on, nothing is written and the worker learns [`StoreError::LeaseLost`].
//! - **Lease**: a job is taken from a worker that its supervisor saw die, or that a process has itself seen renew nothing for the
//!   length of a lease. What the clock shows decides nothing of that.
//! - **Events** of a job are numbered from 1 without gaps, and each is written in the transaction of the change
//!   that it records.
//! - **Outbox**: what webhook endpoints are to be told of a job is written in the transaction of its change of state.
//! - **Cancel against completion**: whichever transaction commits first decides. A job whose cancellation was
//!   accepted while it ran never becomes `succeeded`.

mod accounts;
pub mod blobs;
mod datasets;
mod disk_full;
mod error;
mod exports;
pub mod garbage;
mod idempotency;
mod keys;
mod leases;
mod policy;
mod records;
mod retry;
mod series;
mod sqlite;
mod stats;
mod uploads;
mod webhooks;

use futures_util::future::BoxFuture;

pub use accounts::{Accounts, Capacity, Usage};
pub use blobs::{BlobError, BlobWriter, Blobs, ContentHasher, Published, StagedBlob, UploadFile};
pub use datasets::{DatasetCreation, DatasetDeletion, DatasetPageKey, DatasetRecord, Datasets, NewDataset};
pub use disk_full::is_disk_full;
pub use error::StoreError;
pub use exports::{ExportFidelity, ExportRecord, Exports, FileRecord};
pub use idempotency::{Idempotency, IdempotentRequest, PriorRequest};
pub use keys::{KeyRecord, Keys, NewKey, NewKeyError};
pub use policy::QueuePolicy;
pub use records::{
    Artifact, ArtifactKind, AttemptOutcome, AttemptRecord, BlobRef, Cancellation, Claim, Deletion, Heartbeat,
    JobFilter, JobRecord, Lease, NewJob, Outcome, PageKey, RetryOutcome, RetryRequest, SceneArtifact,
    WorkerDeath,
};
pub use series::Series;
pub use sqlite::{SchemaChange, SqliteStore};
pub use stats::{AttemptCount, Overview, StoreStats};
pub use uploads::{NewUpload, UploadRecord, Uploads};
pub use webhooks::{
    AfterAttempt, DeliveryRecord, DeliveryResult, DeliveryState, DueDelivery, EndpointRecord, NewEndpoint,
    Replay, Webhooks,
};

use crate::domain::{Event, JobId, JobState, Phase, Progress};

/// What a store method returns; boxed so that a store can be held as `Arc<dyn Store>`.
pub type StoreFuture<'a, T> = BoxFuture<'a, Result<T, StoreError>>;

/// The job table and its queue. Every method is one transaction.
pub trait Store:
    Accounts
    + Exports
    + Idempotency
    + Keys
    + Overview
    + Datasets
    + Series
    + Uploads
    + Webhooks
    + Send
    + Sync
    + 'static
{
    /// Adds a job in state `queued`, together with its dataset's blob row, its first event and what its request's
    /// `Idempotency-Key` is to be remembered by; [`StoreError::IdempotencyKeyUsed`] if that key was used before.
    fn create_job(&self, new: NewJob) -> StoreFuture<'_, JobRecord>;

    /// The job as it stands.
    fn job(&self, id: JobId) -> StoreFuture<'_, Option<JobRecord>>;

    /// Up to `limit` jobs that pass the filter, newest first, older than `before`.
    fn jobs<'a>(
        &'a self,
        filter: &'a JobFilter,
        before: Option<PageKey>,
        limit: u32,
    ) -> StoreFuture<'a, Vec<JobRecord>>;

    /// Up to `limit` events with numbers above `after`, oldest first; `None` if there is no such job.
    fn events(&self, id: JobId, after: u64, limit: u32) -> StoreFuture<'_, Option<Vec<Event>>>;

    /// The number of the newest event of each of these jobs; one that is not there is left out.
    fn newest_events<'a>(&'a self, jobs: &'a [JobId]) -> StoreFuture<'a, Vec<(JobId, u64)>>;

    /// Every attempt at the job, oldest first.
    fn attempts(&self, id: JobId) -> StoreFuture<'_, Vec<AttemptRecord>>;

    /// Stops a queued job at once, or asks the worker of a running one to stop; `None` if there is no such job.
    fn cancel(&self, id: JobId) -> StoreFuture<'_, Option<Cancellation>>;

    /// Queues a job like this one, which must have failed or been cancelled, for the same owner; `None` if there is no such
    /// job. [`StoreError::IdempotencyKeyUsed`] as in [`Store::create_job`].
    fn retry_job(&self, id: JobId, repeat: RetryRequest) -> StoreFuture<'_, Option<RetryOutcome>>;

    /// Deletes a job that has ended, with its events, attempts and references to blobs, if it has the wanted version;
    /// `None` if there is no such job.
    fn delete_job(&self, id: JobId, version: Option<u64>) -> StoreFuture<'_, Option<Deletion>>;

    /// Fails queued jobs whose deadline has passed, and counts them. Running ones are told by [`Store::heartbeat`].
    fn fail_expired(&self) -> StoreFuture<'_, u64>;

    /// Those of the jobs whose checkpoints may still be gone on from: by themselves, or, for
    /// [`QueuePolicy::checkpoint_ttl`] after they failed or were cancelled, by a job that repeats them.
    fn resumable<'a>(&'a self, jobs: &'a [JobId]) -> StoreFuture<'a, Vec<JobId>>;

    /// Takes for `worker` a job whose time has come: of those of the highest priority one of the owner with the fewest running
    /// jobs, the oldest first.
    ///
    /// As [`Store::expire_leases`] first, so jobs that are taken from their workers can be claimed again here.
    fn claim<'a>(&'a self, worker: &'a str) -> StoreFuture<'a, Option<Claim>>;

    /// Renews a lease and tells whether the job is to stop.
    fn heartbeat<'a>(&'a self, lease: &'a Lease) -> StoreFuture<'a, Heartbeat>;

    /// Records where the attempt is. A change of phase always makes an event, progress at most one per
    /// [`QueuePolicy::progress_event_every`].
    fn report<'a>(&'a self, lease: &'a Lease, phase: Phase, progress: &'a Progress) -> StoreFuture<'a, ()>;

    /// Ends the attempt and returns the state that the job is in now.
    fn finish<'a>(&'a self, lease: &'a Lease, outcome: Outcome) -> StoreFuture<'a, JobState>;

    /// Takes every job from a worker that is known to be dead, and counts them.
    fn expire_worker<'a>(&'a self, worker: &'a str, death: WorkerDeath) -> StoreFuture<'a, u64>;

    /// Takes every job from its worker whose lease has run out while this process looked, and counts them. To be called often:
    /// what happens between two calls is not seen.
    fn expire_leases(&self) -> StoreFuture<'_, u64>;

    /// One round trip to the database.
    fn ping(&self) -> StoreFuture<'_, ()>;
}
