//! State shared by the handlers: the services, the limits, and one of each part that requests share.

use std::{fmt, ops::Deref, sync::Arc};

use tokio::sync::{OnceCell, Semaphore};
use tokio_util::sync::CancellationToken;

use super::{
    config::RequestLimits,
    meters::Meters,
    problem::{ApiResult, ProblemResponse},
    rendering::ViewRenderer,
    services::Services,
    shared::{
        AuthMode, Capacity, Checks, ExportQueue, HeldBytes, InFlight, Reservations, Slot, Slots, StatsCache,
        Throttle, Watcher,
    },
};
use crate::{
    domain::{Credential, ProjectId, ShareSecret},
    store::{Blobs, Store},
};

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
    pub(super) stats: StatsCache,
    pub(super) readiness: Checks,
    pub(super) watcher: Watcher,
    pub(super) in_flight: InFlight,
    pub(super) exports: ExportQueue,
    /// Room for pictures and animations that are being sent.
    pub(super) held_bytes: HeldBytes,
    /// Permits for requests that wait for a job.
    pub(super) waits: Semaphore,
    pub(super) event_streams: Slots<Credential>,
    /// Cancelled once the server shuts down; waiting requests should then respond at once.
    pub(super) draining: CancellationToken,
    pub(super) auth_mode: AuthMode,
    pub(super) throttle: Throttle,
    pub(super) reservations: Reservations,
    /// What shared links are signed with, once it has been read.
    share_secret: OnceCell<ShareSecret>,
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
        let meters = Meters::default();
        let view_renderer = ViewRenderer::new(&limits, services.clone(), meters.clone());
        let throttle = Throttle::new(Arc::clone(&services.clock), limits.access.clone());
        let checks = Arc::new(Semaphore::new(limits.checks));
        let waits = Semaphore::new(limits.waits);
        let exports = ExportQueue::new(limits.exports, limits.exports_waiting);
        let held_bytes = HeldBytes::new(limits.held_bytes);
        let watcher = Watcher::new(services.store.clone(), limits.watch_interval);
        let (store, blobs) = (services.store.clone(), services.blobs.clone());
        let stats = StatsCache::new(store.clone());
        let auth_mode = AuthMode::new(store.clone(), limits.access.without_keys);
        let readiness = Checks::new(store.clone(), blobs.clone(), limits.min_free_space);
        let reservations = Reservations::new(store, blobs, limits.min_free_space);
        let event_streams =
            Slots::new(Capacity { all: limits.event_streams, each: limits.event_streams_per_key });
        Self(Arc::new(App {
            services,
            limits,
            uploads,
            checks,
            view_renderer,
            meters,
            stats,
            readiness,
            watcher,
            in_flight: InFlight::default(),
            exports,
            held_bytes,
            waits,
            event_streams,
            draining,
            auth_mode,
            throttle,
            reservations,
            share_secret: OnceCell::new(),
        }))
    }

    pub(super) fn store(&self) -> &Store {
        &self.services.store
    }

    /// What shared links are signed with, the same in every process of the service.
    ///
    /// # Errors
    /// If the database cannot be read.
    pub(super) async fn share_secret(&self) -> ApiResult<&ShareSecret> {
        let read = async || {
            let offered = ShareSecret::generate(&*self.services.entropy);
            let offered = offered.map_err(|error| ProblemResponse::internal(&error))?;
            Ok::<_, ProblemResponse>(self.store().share_secret(offered).await?)
        };
        self.share_secret.get_or_try_init(read).await
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
}
