//! The exports in progress.
//!
//! Invariants: there is one export of a job's file to a format at a time, which all who ask for it share; running and waiting exports
//! are bounded, for one project and for all.

use std::{
    collections::BTreeMap,
    fmt,
    future::Future,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use futures_util::{
    FutureExt as _,
    future::{BoxFuture, Shared},
};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::slots::{Capacity, Slot, Slots};
use crate::{
    domain::{Digest, JobId, ProjectId},
    http::problem::{ApiResult, ProblemResponse},
    store::ExportRecord,
};

/// Identifies an export: job, source file, name of the format.
pub(crate) type ExportKey = (JobId, Digest, &'static str);

type PendingExport = Shared<BoxFuture<'static, ApiResult<ExportRecord>>>;

/// The queue; clones share it.
#[derive(Clone)]
pub(crate) struct ExportQueue(Arc<Inner>);

struct Inner {
    /// Running and waiting exports, of which one project leaves places to the others.
    slots: Slots<ProjectId>,
    /// Running exports.
    permits: Arc<Semaphore>,
    pending: Mutex<BTreeMap<ExportKey, PendingExport>>,
}

/// Leave to run one export, until this is dropped.
pub(crate) struct ExportTurn {
    _slot: Slot<ProjectId>,
    _permit: OwnedSemaphorePermit,
}

/// Removes an export from those in progress when it ends.
struct PendingGuard {
    queue: ExportQueue,
    key: ExportKey,
}

impl Drop for PendingGuard {
    fn drop(&mut self) {
        self.queue.pending().remove(&self.key);
    }
}

impl fmt::Debug for ExportQueue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ExportQueue").field("slots", &self.0.slots).finish_non_exhaustive()
    }
}

impl ExportQueue {
    /// A queue that runs `at_once` exports while `waiting` more wait.
    pub(crate) fn new(at_once: usize, waiting: usize) -> Self {
        let at_once = at_once.max(1);
        let slots = Slots::new(Capacity::shared(at_once + waiting));
        Self(Arc::new(Inner { slots, permits: Arc::new(Semaphore::new(at_once)), pending: Mutex::default() }))
    }

    fn pending(&self) -> MutexGuard<'_, BTreeMap<ExportKey, PendingExport>> {
        self.0.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The result of the export with this key that is in progress, or else of the one that `make` begins. It goes on even if all who
    /// wait for it leave.
    ///
    /// # Errors
    /// Those of `make`; 500 if it panics.
    pub(crate) async fn join<F>(&self, key: ExportKey, make: impl FnOnce() -> F) -> ApiResult<ExportRecord>
    where
        F: Future<Output = ApiResult<ExportRecord>> + Send + 'static,
    {
        let begin = || {
            let (guard, export) = (PendingGuard { queue: self.clone(), key }, make());
            let task = tokio::spawn(async move {
                let _guard = guard;
                export.await
            });
            let ended = async { task.await.unwrap_or_else(|error| Err(ProblemResponse::internal(&error))) };
            ended.boxed().shared()
        };
        let pending = self.pending().entry(key).or_insert_with(begin).clone();
        pending.await
    }

    /// Waits for leave to run an export of a project.
    ///
    /// # Errors
    /// 503 if too many wait already, of the project or in all.
    pub(crate) async fn turn(&self, project: ProjectId) -> ApiResult<ExportTurn> {
        let Inner { slots, permits, .. } = &*self.0;
        let slot = slots.take(project).map_err(|taken| {
            ProblemResponse::busy(match taken.by_all < slots.capacity().all {
                true => "too many of your project's exports are in progress",
                false => "too many exports are in progress",
            })
        })?;
        let permit = Arc::clone(permits).acquire_owned().await?;
        Ok(ExportTurn { _slot: slot, _permit: permit })
    }
}
