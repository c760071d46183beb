//! A store that fails when told to.

mod keys;
mod projects;
mod series;
mod viewers;
mod webhooks;

use std::{
    io,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use futures_util::future::BoxFuture;
use jiff::{SignedDuration, Timestamp};
use tcgs::{
    domain::{DatasetId, Digest, Event, JobId, JobState, Phase, Progress, ProjectId, UploadId},
    store::{
        Accounts, AttemptRecord, BlobRef, Cancellation, Capacity, ChangeKind, Changes, Claim,
        DatasetCreation, DatasetDeletion, DatasetPageKey, DatasetRecord, Datasets, Deletion, ExportRecord,
        Exports, FileRecord, Heartbeat, Idempotency, JobFilter, JobRecord, Lease, NewDataset, NewJob,
        NewUpload, Outcome, Overview, PageKey, PriorRequest, RemovedJobs, Retention, RetryOutcome,
        RetryRequest, Store, StoreError, StoreFuture, StoreStats, UploadRecord, Uploads, Usage, WorkerDeath,
    },
};

/// How calls fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failing {
    /// Like a database that is busy.
    Busy,
    /// Like one that is gone.
    Gone,
    /// Like one on a full disk.
    Full,
    /// Like one on a disk with room for small changes only: no attempt can end.
    FullForEnds,
    /// Like one that answers on a full disk: it can be read, and nothing shows the fault but an attempt to write.
    FullForProbes,
    /// Like one that does not answer in time: what creates something has failed, and is done once the test says so.
    Late,
    /// Not at all, but a newer program has changed the schema.
    Migrated,
}

/// Passes calls on to a store, or fails them.
pub struct FaultStore {
    inner: Arc<dyn Store>,
    failing: Mutex<Option<Failing>>,
    refused_ends: AtomicU32,
    largest_reads: AtomicU32,
    pings: AtomicU32,
    /// How far its clock is ahead.
    ahead: Mutex<SignedDuration>,
    /// What is still to be done.
    late: Mutex<Vec<BoxFuture<'static, ()>>>,
}

impl FaultStore {
    pub fn new(inner: Arc<dyn Store>) -> Self {
        Self {
            inner,
            failing: Mutex::new(None),
            refused_ends: AtomicU32::new(0),
            largest_reads: AtomicU32::new(0),
            pings: AtomicU32::new(0),
            ahead: Mutex::default(),
            late: Mutex::default(),
        }
    }

    /// From now on, every call fails so, or none does.
    pub fn set(&self, failing: Option<Failing>) {
        *self.failing.lock().expect("not poisoned") = failing;
    }

    /// Whether calls fail by plan.
    pub fn is_failing(&self) -> bool {
        self.failing.lock().expect("not poisoned").is_some()
    }

    /// From now on, its clock is so far ahead of the service's.
    pub fn set_ahead(&self, ahead: SignedDuration) {
        *self.ahead.lock().expect("not poisoned") = ahead;
    }

    /// How many ends of attempts were refused by [`Failing::FullForEnds`].
    pub fn refused_ends(&self) -> u32 {
        self.refused_ends.load(Ordering::SeqCst)
    }

    /// How often a project's largest dataset was looked for.
    pub fn largest_reads(&self) -> u32 {
        self.largest_reads.load(Ordering::SeqCst)
    }

    /// How often the database was asked whether it answers.
    pub fn pings(&self) -> u32 {
        self.pings.load(Ordering::SeqCst)
    }

    fn guard<'a, T: Send + 'a>(&self, answer: StoreFuture<'a, T>) -> StoreFuture<'a, T> {
        let error = match *self.failing.lock().expect("not poisoned") {
            None
            | Some(Failing::Migrated | Failing::FullForEnds | Failing::FullForProbes | Failing::Late) => {
                return answer;
            }
            Some(Failing::Busy) => sqlx::Error::PoolTimedOut,
            Some(Failing::Gone) => sqlx::Error::PoolClosed,
            Some(Failing::Full) => full(),
        };
        Box::pin(async move { Err(StoreError::Database(error)) })
    }
}

impl FaultStore {
    /// Does what was given up by [`Failing::Late`].
    pub async fn catch_up(&self) {
        let late = std::mem::take(&mut *self.late.lock().expect("not poisoned"));
        for call in late {
            call.await;
        }
    }

    /// A call that creates something.
    fn create<T: Send + 'static>(
        &self,
        call: impl Future<Output = Result<T, StoreError>> + Send + 'static,
    ) -> StoreFuture<'_, T> {
        if *self.failing.lock().expect("not poisoned") != Some(Failing::Late) {
            return self.guard(Box::pin(call));
        }
        let call = async { drop(call.await.expect("created in the end")) };
        self.late.lock().expect("not poisoned").push(Box::pin(call));
        Box::pin(async { Err(StoreError::Database(sqlx::Error::Io(io::ErrorKind::TimedOut.into()))) })
    }
}

fn full() -> sqlx::Error {
    sqlx::Error::Io(io::ErrorKind::StorageFull.into())
}

impl Overview for FaultStore {
    fn stats(&self) -> StoreFuture<'_, StoreStats> {
        self.guard(self.inner.stats())
    }
    fn schema_is_current(&self) -> StoreFuture<'_, bool> {
        if *self.failing.lock().expect("not poisoned") == Some(Failing::Migrated) {
            return Box::pin(async { Ok(false) });
        }
        self.guard(self.inner.schema_is_current())
    }
    fn probe(&self) -> StoreFuture<'_, ()> {
        if *self.failing.lock().expect("not poisoned") == Some(Failing::FullForProbes) {
            return Box::pin(async { Err(StoreError::Database(full())) });
        }
        self.guard(self.inner.probe())
    }
}

impl Exports for FaultStore {
    fn admit_export(&self, job: JobId) -> StoreFuture<'_, ()> {
        self.guard(self.inner.admit_export(job))
    }
    fn add_export(&self, export: ExportRecord) -> StoreFuture<'_, Option<ExportRecord>> {
        let inner = Arc::clone(&self.inner);
        self.create(async move { inner.add_export(export).await })
    }
    fn exports(&self, job: JobId) -> StoreFuture<'_, Vec<ExportRecord>> {
        self.guard(self.inner.exports(job))
    }
    fn file(&self, digest: Digest, project: Option<ProjectId>) -> StoreFuture<'_, Option<FileRecord>> {
        self.guard(self.inner.file(digest, project))
    }
}

impl Idempotency for FaultStore {
    fn prior_request<'a>(
        &'a self,
        project: ProjectId,
        key: &'a str,
    ) -> StoreFuture<'a, Option<PriorRequest>> {
        self.guard(self.inner.prior_request(project, key))
    }
}

impl Retention for FaultStore {
    fn remove_ended_jobs(&self, keep: Duration, after: Option<PageKey>) -> StoreFuture<'_, RemovedJobs> {
        self.guard(self.inner.remove_ended_jobs(keep, after))
    }
    fn remove_expired_records(&self, keep: Option<Duration>) -> StoreFuture<'_, u64> {
        self.guard(self.inner.remove_expired_records(keep))
    }
}

impl Store for FaultStore {
    fn time(&self) -> StoreFuture<'_, Timestamp> {
        let ahead = *self.ahead.lock().expect("not poisoned");
        self.guard(Box::pin(async move { Ok(self.inner.time().await? + ahead) }))
    }
    fn create_job(&self, new: NewJob) -> StoreFuture<'_, JobRecord> {
        let inner = Arc::clone(&self.inner);
        self.create(async move { inner.create_job(new).await })
    }
    fn job(&self, id: JobId) -> StoreFuture<'_, Option<JobRecord>> {
        self.guard(self.inner.job(id))
    }
    fn jobs<'a>(
        &'a self,
        filter: &'a JobFilter,
        before: Option<PageKey>,
        limit: u32,
    ) -> StoreFuture<'a, Vec<JobRecord>> {
        self.guard(self.inner.jobs(filter, before, limit))
    }
    fn events(&self, id: JobId, after: u64, limit: u32) -> StoreFuture<'_, Option<Vec<Event>>> {
        self.guard(self.inner.events(id, after, limit))
    }
    fn newest_events<'a>(&'a self, jobs: &'a [JobId]) -> StoreFuture<'a, Vec<(JobId, u64)>> {
        self.guard(self.inner.newest_events(jobs))
    }
    fn attempts(&self, id: JobId) -> StoreFuture<'_, Vec<AttemptRecord>> {
        self.guard(self.inner.attempts(id))
    }
    fn cancel(&self, id: JobId) -> StoreFuture<'_, Option<Cancellation>> {
        self.guard(self.inner.cancel(id))
    }
    fn retry_job(&self, id: JobId, repeat: RetryRequest) -> StoreFuture<'_, Option<RetryOutcome>> {
        self.guard(self.inner.retry_job(id, repeat))
    }
    fn delete_job(&self, id: JobId, version: Option<u64>) -> StoreFuture<'_, Option<Deletion>> {
        self.guard(self.inner.delete_job(id, version))
    }
    fn fail_expired(&self) -> StoreFuture<'_, u64> {
        self.guard(self.inner.fail_expired())
    }
    fn has_running_job(&self) -> StoreFuture<'_, bool> {
        self.guard(self.inner.has_running_job())
    }
    fn resumable<'a>(&'a self, jobs: &'a [JobId]) -> StoreFuture<'a, Vec<JobId>> {
        self.guard(self.inner.resumable(jobs))
    }
    fn claim<'a>(&'a self, worker: &'a str) -> StoreFuture<'a, Option<Claim>> {
        self.guard(self.inner.claim(worker))
    }
    fn heartbeat<'a>(&'a self, lease: &'a Lease) -> StoreFuture<'a, Heartbeat> {
        self.guard(self.inner.heartbeat(lease))
    }
    fn report<'a>(&'a self, lease: &'a Lease, phase: Phase, progress: &'a Progress) -> StoreFuture<'a, ()> {
        self.guard(self.inner.report(lease, phase, progress))
    }
    fn finish<'a>(&'a self, lease: &'a Lease, outcome: Outcome) -> StoreFuture<'a, JobState> {
        if *self.failing.lock().expect("not poisoned") == Some(Failing::FullForEnds) {
            self.refused_ends.fetch_add(1, Ordering::SeqCst);
            return Box::pin(async { Err(StoreError::Database(full())) });
        }
        self.guard(self.inner.finish(lease, outcome))
    }
    fn expire_worker<'a>(&'a self, worker: &'a str, death: WorkerDeath) -> StoreFuture<'a, u64> {
        self.guard(self.inner.expire_worker(worker, death))
    }
    fn expire_leases(&self) -> StoreFuture<'_, u64> {
        self.guard(self.inner.expire_leases())
    }
    fn changes(&self, kind: ChangeKind) -> Changes {
        self.inner.changes(kind)
    }
    fn ping(&self) -> StoreFuture<'_, ()> {
        self.pings.fetch_add(1, Ordering::SeqCst);
        self.guard(self.inner.ping())
    }
}

impl Datasets for FaultStore {
    fn create_dataset(&self, new: NewDataset) -> StoreFuture<'_, DatasetCreation> {
        let inner = Arc::clone(&self.inner);
        self.create(async move { inner.create_dataset(new).await })
    }
    fn dataset(&self, id: DatasetId) -> StoreFuture<'_, Option<DatasetRecord>> {
        self.guard(self.inner.dataset(id))
    }
    fn dataset_by_archive(
        &self,
        project: ProjectId,
        dataset: Digest,
    ) -> StoreFuture<'_, Option<DatasetRecord>> {
        self.guard(self.inner.dataset_by_archive(project, dataset))
    }
    fn datasets(
        &self,
        project: Option<ProjectId>,
        before: Option<DatasetPageKey>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<DatasetRecord>> {
        self.guard(self.inner.datasets(project, before, limit))
    }
    fn delete_dataset(
        &self,
        id: DatasetId,
        version: Option<u64>,
    ) -> StoreFuture<'_, Option<DatasetDeletion>> {
        self.guard(self.inner.delete_dataset(id, version))
    }
}

impl Uploads for FaultStore {
    fn create_upload(&self, new: NewUpload) -> StoreFuture<'_, UploadRecord> {
        self.guard(self.inner.create_upload(new))
    }
    fn upload(&self, id: UploadId) -> StoreFuture<'_, Option<UploadRecord>> {
        self.guard(self.inner.upload(id))
    }
    fn advance_upload(&self, id: UploadId, received: u64, expires_at: Timestamp) -> StoreFuture<'_, bool> {
        self.guard(self.inner.advance_upload(id, received, expires_at))
    }
    fn delete_upload(&self, id: UploadId) -> StoreFuture<'_, bool> {
        self.guard(self.inner.delete_upload(id))
    }
    fn outstanding_bytes(&self) -> StoreFuture<'_, u64> {
        self.guard(self.inner.outstanding_bytes())
    }
    fn expire_uploads(&self, forget: Timestamp) -> StoreFuture<'_, Vec<UploadId>> {
        self.guard(self.inner.expire_uploads(forget))
    }
    fn open_uploads(&self) -> StoreFuture<'_, Vec<UploadId>> {
        self.guard(self.inner.open_uploads())
    }
}

impl Accounts for FaultStore {
    fn usage(&self, project: ProjectId) -> StoreFuture<'_, Usage> {
        self.guard(self.inner.usage(project))
    }
    fn capacity(&self, project: ProjectId) -> StoreFuture<'_, Capacity> {
        self.guard(self.inner.capacity(project))
    }
    fn largest_dataset(&self, project: ProjectId) -> StoreFuture<'_, u64> {
        self.largest_reads.fetch_add(1, Ordering::SeqCst);
        self.guard(self.inner.largest_dataset(project))
    }
    fn owned_archive(&self, project: ProjectId, content: Digest) -> StoreFuture<'_, Option<BlobRef>> {
        self.guard(self.inner.owned_archive(project, content))
    }
    fn forget_blobs<'a>(&'a self, digests: &'a [Digest]) -> StoreFuture<'a, Vec<Digest>> {
        self.guard(self.inner.forget_blobs(digests))
    }
}
