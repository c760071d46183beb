//! A store that fails when told to.

mod series;
mod webhooks;

use std::sync::{Arc, Mutex};

use tcgs::{
    domain::{Event, JobId, JobState, Phase, Progress},
    store::{
        Answer, AttemptRecord, Cancellation, Claim, Heartbeat, JobFilter, JobRecord, Lease, NewJob, Outcome,
        PageKey, Store, StoreError,
    },
};

/// How calls fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failing {
    /// Like a database that is busy.
    Busy,
    /// Like one that is gone.
    Gone,
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
            None => return answer,
            Some(Failing::Busy) => sqlx::Error::PoolTimedOut,
            Some(Failing::Gone) => sqlx::Error::PoolClosed,
        };
        Box::pin(async move { Err(StoreError::Database(error)) })
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
    fn attempts(&self, id: JobId) -> Answer<'_, Vec<AttemptRecord>> {
        self.guard(self.inner.attempts(id))
    }
    fn cancel(&self, id: JobId) -> Answer<'_, Option<Cancellation>> {
        self.guard(self.inner.cancel(id))
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
    fn expire_worker<'a>(&'a self, worker: &'a str) -> Answer<'a, u64> {
        self.guard(self.inner.expire_worker(worker))
    }
    fn ping(&self) -> Answer<'_, ()> {
        self.guard(self.inner.ping())
    }
}
