//! State shared by the handlers. Its services are passed in, so that tests can replace them and layers stay separate.

use std::{fmt, ops::Deref, sync::Arc};

use bytes::Bytes;
use tokio::{runtime::Handle, sync::Semaphore};
use tokio_util::sync::CancellationToken;
use uuid::{NoContext, Uuid};

use super::{
    auth::{AuthMode, throttle::Throttle},
    config::RequestLimits,
    files::exports::ExportQueue,
    jobs::watcher::Watcher,
    metrics::{Cache, Meters},
    problem::{ApiResult, ProblemResponse},
    request::{Reservations, idempotency::InFlight},
    server::readiness::Checks,
    slots::{Capacity, Slot, Slots},
    views::ViewRenderer,
};
use crate::{
    domain::{Clock, Digest, KeyId, Problem, ProjectId, RandomSource, Workers},
    engine::SceneEngine,
    store::{Blobs, Store},
};

/// The services that the handlers use.
#[derive(Clone)]
pub struct Services {
    /// Jobs and events.
    pub store: Arc<Store>,
    /// Datasets and results.
    pub blobs: Blobs,
    /// Time.
    pub clock: Arc<dyn Clock>,
    /// Cryptographic randomness.
    pub entropy: Arc<dyn RandomSource>,
    /// Checks, views and exports.
    pub engine: Arc<dyn SceneEngine>,
    /// The worker processes.
    pub workers: Arc<dyn Workers>,
}

impl Services {
    /// The content of a blob; blocks.
    pub(super) fn read(&self, runtime: &Handle, digest: Digest) -> Result<Bytes, Problem> {
        read_blob(&self.blobs, runtime, digest)
    }
}

/// The content of a blob; blocks on `runtime`.
pub(super) fn read_blob(blobs: &Blobs, runtime: &Handle, digest: Digest) -> Result<Bytes, Problem> {
    runtime.block_on(blobs.read(digest)).map_err(|error| ProblemResponse::from(error).into_problem())
}

/// The handlers' shared state; clones share it.
#[derive(Clone)]
pub struct AppState(Arc<App>);

/// What [`AppState`] shares.
pub struct App {
    pub(super) services: Services,
    pub(super) limits: RequestLimits,
    uploads: Slots<ProjectId>,
    /// Permits for checks of datasets.
    pub(super) checks: Arc<Semaphore>,
    pub(super) view_renderer: ViewRenderer,
    pub(super) meters: Meters,
    pub(super) metrics_cache: Cache,
    pub(super) readiness: Checks,
    pub(super) watcher: Watcher,
    pub(super) in_flight: Arc<InFlight>,
    pub(super) exports: ExportQueue,
    /// Permits for requests that wait for a job.
    pub(super) waits: Semaphore,
    pub(super) event_streams: Slots<Option<KeyId>>,
    /// Cancelled once the server shuts down; waiting requests should then respond at once.
    pub(super) draining: CancellationToken,
    pub(super) auth_mode: AuthMode,
    pub(super) throttle: Throttle,
    pub(super) reservations: Reservations,
}

impl Deref for AppState {
    type Target = App;

    fn deref(&self) -> &App {
        &self.0
    }
}

impl fmt::Debug for AppState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("AppState").field("limits", &self.limits).finish_non_exhaustive()
    }
}

impl AppState {
    /// State that reports itself not ready once `draining` is cancelled.
    #[must_use]
    pub fn new(services: Services, limits: RequestLimits, draining: CancellationToken) -> Self {
        // A project that sends slowly leaves places to the others.
        let uploads = Slots::new(Capacity::shared(limits.uploads));
        let view_renderer = ViewRenderer::new(&limits);
        let throttle = Throttle::new(Arc::clone(&services.clock), limits.access.clone());
        let checks = Arc::new(Semaphore::new(limits.checks));
        let waits = Semaphore::new(limits.waits);
        let exports = ExportQueue::new(limits.exports, limits.exports_waiting);
        let watcher = Watcher::new(Arc::clone(&services.store), limits.watch_interval);
        let event_streams =
            Slots::new(Capacity { all: limits.event_streams, each: limits.event_streams_per_key });
        Self(Arc::new(App {
            services,
            limits,
            uploads,
            checks,
            view_renderer,
            meters: Meters::default(),
            metrics_cache: Cache::default(),
            readiness: Checks::default(),
            watcher,
            in_flight: Arc::default(),
            exports,
            waits,
            event_streams,
            draining,
            auth_mode: AuthMode::default(),
            throttle,
            reservations: Reservations::default(),
        }))
    }

    pub(super) fn store(&self) -> &Store {
        &self.services.store
    }

    pub(super) fn blobs(&self) -> &Blobs {
        &self.services.blobs
    }

    /// A place to receive an archive of a project.
    ///
    /// # Errors
    /// 503 if all are taken, or all that one project may have.
    pub(super) fn upload_slot(&self, project: ProjectId) -> ApiResult<Slot<ProjectId>> {
        self.uploads.take(project).map_err(|taken| {
            let detail = match taken.by_all < self.uploads.capacity().all {
                true => "too many datasets of your project are being received",
                false => "too many datasets are being received",
            };
            ProblemResponse::busy(detail)
        })
    }

    /// A UUID of version 7 whose time is the service's clock, so that ids sort in the order of creation.
    pub(super) fn new_uuid(&self) -> Uuid {
        let now = self.services.clock.now();
        let seconds = u64::try_from(now.as_second()).unwrap_or(0);
        let nanoseconds = u32::try_from(now.subsec_nanosecond()).unwrap_or(0);
        Uuid::new_v7(uuid::Timestamp::from_unix(NoContext, seconds, nanoseconds))
    }
}
