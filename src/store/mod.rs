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
mod disk_full;
mod error;
mod exports;
mod figures;
pub mod housekeeping;
mod idempotency;
mod keys;
mod leases;
mod policy;
mod records;
mod scenes;
mod series;
mod sqlite;
mod uploads;
mod verdict;
mod webhooks;

use futures_util::future::BoxFuture;

pub use accounts::{Accounts, Room, Usage};
pub use blobs::{BlobError, Blobs, ContentHash, Published, Staged, Staging, UploadFile};
pub use disk_full::is_disk_full;
pub use error::StoreError;
pub use exports::{ExportRecord, Exports, FileRecord, Likeness};
pub use figures::{AttemptCount, Figures, Overview};
pub use idempotency::{Idempotency, Intent, Remembered};
pub use keys::{KeyRecord, Keys, NewKey, NewKeyError};
pub use policy::QueuePolicy;
pub use records::{
    Artifact, ArtifactKind, AttemptOutcome, AttemptRecord, BlobRef, Cancellation, Claim, Death, Deletion,
    Heartbeat, JobFilter, JobRecord, Lease, NewJob, Outcome, PageKey, Repeat, Repetition, SceneArtifact,
};
pub use scenes::{NewScene, SceneCreation, SceneDeletion, ScenePage, SceneRecord, Scenes};
pub use series::Series;
pub use sqlite::{SchemaChange, SqliteStore};
pub use uploads::{NewUpload, UploadRecord, Uploads};
pub use webhooks::{
    AfterAttempt, DeliveryRecord, DeliveryState, DueDelivery, EndpointRecord, NewEndpoint, Replay, Settled,
    Webhooks,
};

use crate::domain::{Event, JobId, JobState, Phase, Progress};

/// What a store method returns; boxed so that a store can be held as `Arc<dyn Store>`.
pub type Answer<'a, T> = BoxFuture<'a, Result<T, StoreError>>;

/// The job table and its queue. Every method is one transaction.
pub trait Store:
    Accounts
    + Exports
    + Idempotency
    + Keys
    + Overview
    + Scenes
    + Series
    + Uploads
    + Webhooks
    + Send
    + Sync
    + 'static
{
    /// Adds a job in state `queued`, together with its dataset's blob row, its first event and what its request's
    /// `Idempotency-Key` is to be remembered by; [`StoreError::AlreadyMade`] if that key was used before.
    fn create_job(&self, new: NewJob) -> Answer<'_, JobRecord>;

    /// The job as it stands.
    fn job(&self, id: JobId) -> Answer<'_, Option<JobRecord>>;

    /// Up to `limit` jobs that pass the filter, newest first, older than `before`.
    fn jobs<'a>(
        &'a self,
        filter: &'a JobFilter,
        before: Option<PageKey>,
        limit: u32,
    ) -> Answer<'a, Vec<JobRecord>>;

    /// Up to `limit` events with numbers above `after`, oldest first; `None` if there is no such job.
    fn events(&self, id: JobId, after: u64, limit: u32) -> Answer<'_, Option<Vec<Event>>>;

    /// The number of the newest event of each of these jobs; one that is not there is left out.
    fn newest_events<'a>(&'a self, jobs: &'a [JobId]) -> Answer<'a, Vec<(JobId, u64)>>;

    /// Every attempt at the job, oldest first.
    fn attempts(&self, id: JobId) -> Answer<'_, Vec<AttemptRecord>>;

    /// Stops a queued job at once, or asks the worker of a running one to stop; `None` if there is no such job.
    fn cancel(&self, id: JobId) -> Answer<'_, Option<Cancellation>>;

    /// Queues a job like this one, which must have failed or been cancelled, for the same owner; `None` if there is no such
    /// job. [`StoreError::AlreadyMade`] as in [`Store::create_job`].
    fn repeat_job(&self, id: JobId, repeat: Repeat) -> Answer<'_, Option<Repetition>>;

    /// Deletes a job that has ended, with its events, attempts and references to blobs, if it has the wanted version;
    /// `None` if there is no such job.
    fn delete_job(&self, id: JobId, version: Option<u64>) -> Answer<'_, Option<Deletion>>;

    /// Fails queued jobs whose deadline has passed, and counts them. Running ones are told by [`Store::heartbeat`].
    fn give_up_overdue(&self) -> Answer<'_, u64>;

    /// Those of the jobs whose checkpoints may still be gone on from: by themselves, or, for
    /// [`QueuePolicy::keep_checkpoints`] after they failed or were cancelled, by a job that repeats them.
    fn resumable<'a>(&'a self, jobs: &'a [JobId]) -> Answer<'a, Vec<JobId>>;

    /// Takes for `worker` a job whose time has come: of those of the highest priority one of the owner with the fewest running
    /// jobs, the oldest first.
    ///
    /// As [`Store::expire_leases`] first, so jobs that are taken from their workers can be claimed again here.
    fn claim<'a>(&'a self, worker: &'a str) -> Answer<'a, Option<Claim>>;

    /// Renews a lease and tells whether the job is to stop.
    fn heartbeat<'a>(&'a self, lease: &'a Lease) -> Answer<'a, Heartbeat>;

    /// Records where the attempt is. A change of phase always makes an event, progress at most one per
    /// [`QueuePolicy::progress_event_every`].
    fn report<'a>(&'a self, lease: &'a Lease, phase: Phase, progress: &'a Progress) -> Answer<'a, ()>;

    /// Ends the attempt and returns the state that the job is in now.
    fn finish<'a>(&'a self, lease: &'a Lease, outcome: Outcome) -> Answer<'a, JobState>;

    /// Takes every job from a worker that is known to be dead, and counts them.
    fn expire_worker<'a>(&'a self, worker: &'a str, death: Death) -> Answer<'a, u64>;

    /// Takes every job from its worker whose lease has run out while this process looked, and counts them. To be called often:
    /// what happens between two calls is not seen.
    fn expire_leases(&self) -> Answer<'_, u64>;

    /// One round trip to the database.
    fn ping(&self) -> Answer<'_, ()>;
}
