//! A store that fails when told to.

mod keys;
mod series;
mod webhooks;

use std::{
    io,
    sync::{Arc, Mutex},
};

use jiff::Timestamp;
use tcgs::{
    domain::{Digest, Event, JobId, JobState, KeyId, Phase, Progress, SceneId, UploadId},
    store::{
        Accounts, Answer, AttemptRecord, BlobRef, Cancellation, Claim, Death, Deletion, ExportRecord,
        Exports, Figures, FileRecord, Heartbeat, Idempotency, JobFilter, JobRecord, Lease, NewJob, NewScene,
        NewUpload, Outcome, Overview, PageKey, Remembered, Repeat, Repetition, Room, SceneCreation,
        SceneDeletion, ScenePage, SceneRecord, Scenes, Store, StoreError, UploadRecord, Uploads, Usage,
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
    /// Not at all, but a newer program has changed the schema.
    Migrated,
}

/// Passes calls on to a store, or fails them.
pub struct FaultStore {
    inner: Arc<dyn Store>,
    failing: Mutex<Option<Failing>>,
}

impl FaultStore {
    pub fn new(inner: Arc<dyn Store>) -> Self {
        Self { inner, failing: Mutex::new(None) }
    }

    /// From now on, every call fails so, or none does.
    pub fn set(&self, failing: Option<Failing>) {
        *self.failing.lock().expect("not poisoned") = failing;
    }

    fn guard<'a, T: Send + 'a>(&self, answer: Answer<'a, T>) -> Answer<'a, T> {
        let error = match *self.failing.lock().expect("not poisoned") {
            None | Some(Failing::Migrated) => return answer,
            Some(Failing::Busy) => sqlx::Error::PoolTimedOut,
            Some(Failing::Gone) => sqlx::Error::PoolClosed,
            Some(Failing::Full) => sqlx::Error::Io(io::ErrorKind::StorageFull.into()),
        };
        Box::pin(async move { Err(StoreError::Database(error)) })
    }
}

impl Overview for FaultStore {
    fn figures(&self) -> Answer<'_, Figures> {
        self.guard(self.inner.figures())
    }
    fn schema_is_current(&self) -> Answer<'_, bool> {
        if *self.failing.lock().expect("not poisoned") == Some(Failing::Migrated) {
            return Box::pin(async { Ok(false) });
        }
        self.guard(self.inner.schema_is_current())
    }
    fn probe(&self) -> Answer<'_, ()> {
        self.guard(self.inner.probe())
    }
}

impl Exports for FaultStore {
    fn admit_export(&self, job: JobId) -> Answer<'_, ()> {
        self.guard(self.inner.admit_export(job))
    }
    fn add_export(&self, export: ExportRecord) -> Answer<'_, Option<ExportRecord>> {
        self.guard(self.inner.add_export(export))
    }
    fn exports(&self, job: JobId) -> Answer<'_, Vec<ExportRecord>> {
        self.guard(self.inner.exports(job))
    }
    fn file(&self, digest: Digest, owner: Option<KeyId>) -> Answer<'_, Option<FileRecord>> {
        self.guard(self.inner.file(digest, owner))
    }
}

impl Idempotency for FaultStore {
    fn remembered<'a>(&'a self, owner: Option<KeyId>, key: &'a str) -> Answer<'a, Option<Remembered>> {
        self.guard(self.inner.remembered(owner, key))
    }
}

impl Store for FaultStore {
    fn create_job(&self, new: NewJob) -> Answer<'_, JobRecord> {
        self.guard(self.inner.create_job(new))
    }
    fn job(&self, id: JobId) -> Answer<'_, Option<JobRecord>> {
        self.guard(self.inner.job(id))
    }
    fn jobs<'a>(
        &'a self,
        filter: &'a JobFilter,
        before: Option<PageKey>,
        limit: u32,
    ) -> Answer<'a, Vec<JobRecord>> {
        self.guard(self.inner.jobs(filter, before, limit))
    }
    fn events(&self, id: JobId, after: u64, limit: u32) -> Answer<'_, Option<Vec<Event>>> {
        self.guard(self.inner.events(id, after, limit))
    }
    fn newest_events<'a>(&'a self, jobs: &'a [JobId]) -> Answer<'a, Vec<(JobId, u64)>> {
        self.guard(self.inner.newest_events(jobs))
    }
    fn attempts(&self, id: JobId) -> Answer<'_, Vec<AttemptRecord>> {
        self.guard(self.inner.attempts(id))
    }
    fn cancel(&self, id: JobId) -> Answer<'_, Option<Cancellation>> {
        self.guard(self.inner.cancel(id))
    }
    fn repeat_job(&self, id: JobId, repeat: Repeat) -> Answer<'_, Option<Repetition>> {
        self.guard(self.inner.repeat_job(id, repeat))
    }
    fn delete_job(&self, id: JobId, version: Option<u64>) -> Answer<'_, Option<Deletion>> {
        self.guard(self.inner.delete_job(id, version))
    }
    fn give_up_overdue(&self) -> Answer<'_, u64> {
        self.guard(self.inner.give_up_overdue())
    }
    fn resumable<'a>(&'a self, jobs: &'a [JobId]) -> Answer<'a, Vec<JobId>> {
        self.guard(self.inner.resumable(jobs))
    }
    fn claim<'a>(&'a self, worker: &'a str) -> Answer<'a, Option<Claim>> {
        self.guard(self.inner.claim(worker))
    }
    fn heartbeat<'a>(&'a self, lease: &'a Lease) -> Answer<'a, Heartbeat> {
        self.guard(self.inner.heartbeat(lease))
    }
    fn report<'a>(&'a self, lease: &'a Lease, phase: Phase, progress: &'a Progress) -> Answer<'a, ()> {
        self.guard(self.inner.report(lease, phase, progress))
    }
    fn finish<'a>(&'a self, lease: &'a Lease, outcome: Outcome) -> Answer<'a, JobState> {
        self.guard(self.inner.finish(lease, outcome))
    }
    fn expire_worker<'a>(&'a self, worker: &'a str, death: Death) -> Answer<'a, u64> {
        self.guard(self.inner.expire_worker(worker, death))
    }
    fn expire_leases(&self) -> Answer<'_, u64> {
        self.guard(self.inner.expire_leases())
    }
    fn ping(&self) -> Answer<'_, ()> {
        self.guard(self.inner.ping())
    }
}

impl Scenes for FaultStore {
    fn create_scene(&self, new: NewScene) -> Answer<'_, SceneCreation> {
        self.guard(self.inner.create_scene(new))
    }
    fn scene(&self, id: SceneId) -> Answer<'_, Option<SceneRecord>> {
        self.guard(self.inner.scene(id))
    }
    fn scene_of_dataset(&self, owner: Option<KeyId>, dataset: Digest) -> Answer<'_, Option<SceneRecord>> {
        self.guard(self.inner.scene_of_dataset(owner, dataset))
    }
    fn scenes(
        &self,
        owner: Option<KeyId>,
        before: Option<ScenePage>,
        limit: u32,
    ) -> Answer<'_, Vec<SceneRecord>> {
        self.guard(self.inner.scenes(owner, before, limit))
    }
    fn delete_scene(&self, id: SceneId, version: Option<u64>) -> Answer<'_, Option<SceneDeletion>> {
        self.guard(self.inner.delete_scene(id, version))
    }
}

impl Uploads for FaultStore {
    fn create_upload(&self, new: NewUpload) -> Answer<'_, UploadRecord> {
        self.guard(self.inner.create_upload(new))
    }
    fn upload(&self, id: UploadId) -> Answer<'_, Option<UploadRecord>> {
        self.guard(self.inner.upload(id))
    }
    fn advance_upload(&self, id: UploadId, received: u64, expires_at: Timestamp) -> Answer<'_, bool> {
        self.guard(self.inner.advance_upload(id, received, expires_at))
    }
    fn delete_upload(&self, id: UploadId) -> Answer<'_, bool> {
        self.guard(self.inner.delete_upload(id))
    }
    fn outstanding_bytes(&self) -> Answer<'_, u64> {
        self.guard(self.inner.outstanding_bytes())
    }
    fn expire_uploads(&self, forget: Timestamp) -> Answer<'_, Vec<UploadId>> {
        self.guard(self.inner.expire_uploads(forget))
    }
    fn open_uploads(&self) -> Answer<'_, Vec<UploadId>> {
        self.guard(self.inner.open_uploads())
    }
}

impl Accounts for FaultStore {
    fn usage(&self, owner: Option<KeyId>) -> Answer<'_, Usage> {
        self.guard(self.inner.usage(owner))
    }
    fn room(&self, owner: Option<KeyId>) -> Answer<'_, Room> {
        self.guard(self.inner.room(owner))
    }
    fn dataset(&self, owner: Option<KeyId>, content: Digest) -> Answer<'_, Option<BlobRef>> {
        self.guard(self.inner.dataset(owner, content))
    }
    fn forget_blobs<'a>(&'a self, digests: &'a [Digest]) -> Answer<'a, Vec<Digest>> {
        self.guard(self.inner.forget_blobs(digests))
    }
}
