//! What the handlers share. The collaborators are handed in, so tests replace them and layers stay apart.

use std::{fmt, path::Path, sync::Arc};

use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use super::{
    auth::Lock,
    config::RequestLimits,
    exports::ExportQueue,
    idempotency::InFlight,
    metrics::{Cache, Meters},
    readiness::Checks,
    space::Space,
    stream_places::StreamPlaces,
    throttle::Throttle,
    views::Studio,
    watch::Watcher,
};
use crate::{
    domain::{Clock, DatasetSummary, Entropy, JobId, NamedCamera, Problem, SceneFormat},
    render::{RenderViews, views::Viewable},
    store::{Blobs, ExportFidelity, Store},
};

/// Looks over a dataset archive before a scene or a job is made of it; blocks.
pub type DatasetCheck = Arc<dyn Fn(&Path) -> Result<DatasetSummary, Problem> + Send + Sync>;

/// Reads a finished scene's file; blocks.
pub type SceneLoader = Arc<dyn Fn(&[u8]) -> Result<Viewable, Problem> + Send + Sync>;

/// Writes a finished scene in another format so that it looks alike from the dataset's cameras, and looks how alike; blocks.
pub type SceneExporter =
    Arc<dyn Fn(&[u8], SceneFormat, &[NamedCamera]) -> Result<ExportedScene, Problem> + Send + Sync>;

/// A finished scene in another format.
#[derive(Debug, Clone, PartialEq)]
pub struct ExportedScene {
    /// The file.
    pub bytes: Vec<u8>,
    /// How many Gaussians it has.
    pub gaussians: u64,
    /// Highest degree of its spherical harmonics.
    pub sh_degree: u8,
    /// How alike it looks, if that can be told.
    pub fidelity: Option<ExportFidelity>,
}

/// Removes what is kept of a deleted job beside the store and its blobs; blocks.
pub type ForgetJob = Arc<dyn Fn(JobId) + Send + Sync>;

/// Tells how many worker processes there should be and how many live.
pub type WorkerCensus = Arc<dyn Fn() -> WorkerCounts + Send + Sync>;

/// The workers that this server keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorkerCounts {
    /// How many there should be; 0 if others run them.
    pub expected: usize,
    /// How many live.
    pub alive: usize,
}

/// The server's collaborators.
#[derive(Clone)]
pub struct Services {
    /// Jobs and events.
    pub store: Arc<dyn Store>,
    /// Datasets and results.
    pub blobs: Blobs,
    /// Time.
    pub clock: Arc<dyn Clock>,
    /// Randomness that nobody may guess.
    pub entropy: Arc<dyn Entropy>,
    /// See [`DatasetCheck`].
    pub check: DatasetCheck,
    /// See [`SceneLoader`].
    pub load: SceneLoader,
    /// Renders views.
    pub renderer: Arc<dyn RenderViews>,
    /// See [`SceneExporter`].
    pub export: SceneExporter,
    /// See [`ForgetJob`].
    pub forget: ForgetJob,
    /// See [`WorkerCensus`].
    pub workers: WorkerCensus,
}

/// The handlers' shared state; clones share it.
#[derive(Clone)]
pub struct AppState(Arc<Inner>);

struct Inner {
    services: Services,
    limits: RequestLimits,
    uploads: Semaphore,
    studio: Studio,
    meters: Meters,
    metrics_cache: Cache,
    checks: Checks,
    watcher: Watcher,
    in_flight: Arc<InFlight>,
    exports: ExportQueue,
    waits: Semaphore,
    stream_places: StreamPlaces,
    draining: CancellationToken,
    lock: Lock,
    throttle: Throttle,
    space: Space,
}

impl fmt::Debug for AppState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("AppState").field("limits", &self.0.limits).finish_non_exhaustive()
    }
}

impl AppState {
    /// State that reports itself not ready once `draining` is cancelled.
    #[must_use]
    pub fn new(services: Services, limits: RequestLimits, draining: CancellationToken) -> Self {
        let uploads = Semaphore::new(limits.uploads);
        let studio = Studio::new(&services, &limits);
        let throttle = Throttle::new(Arc::clone(&services.clock), limits.access.clone());
        let waits = Semaphore::new(limits.waits);
        let exports = ExportQueue::new(limits.exports, limits.exports_waiting);
        let watcher = Watcher::new(Arc::clone(&services.store), limits.watch_every);
        let stream_places = StreamPlaces::new(limits.event_streams, limits.event_streams_each);
        Self(Arc::new(Inner {
            services,
            limits,
            uploads,
            studio,
            meters: Meters::default(),
            metrics_cache: Cache::default(),
            checks: Checks::default(),
            watcher,
            in_flight: Arc::default(),
            exports,
            waits,
            stream_places,
            draining,
            lock: Lock::default(),
            throttle,
            space: Space::default(),
        }))
    }

    pub(super) fn services(&self) -> &Services {
        &self.0.services
    }

    pub(super) fn store(&self) -> &dyn Store {
        &*self.0.services.store
    }

    pub(super) fn blobs(&self) -> &Blobs {
        &self.0.services.blobs
    }

    pub(super) fn limits(&self) -> &RequestLimits {
        &self.0.limits
    }

    pub(super) fn uploads(&self) -> &Semaphore {
        &self.0.uploads
    }

    pub(super) fn studio(&self) -> &Studio {
        &self.0.studio
    }

    /// What this process counts of itself.
    pub(super) fn meters(&self) -> &Meters {
        &self.0.meters
    }

    pub(super) fn metrics_cache(&self) -> &Cache {
        &self.0.metrics_cache
    }

    pub(super) fn checks(&self) -> &Checks {
        &self.0.checks
    }

    pub(super) fn lock(&self) -> &Lock {
        &self.0.lock
    }

    /// Room that requests have reserved.
    pub(super) fn space(&self) -> &Space {
        &self.0.space
    }

    pub(super) fn throttle(&self) -> &Throttle {
        &self.0.throttle
    }

    /// Keys of requests that are being answered.
    pub(super) fn in_flight(&self) -> &Arc<InFlight> {
        &self.0.in_flight
    }

    /// Places for requests that wait for a job.
    pub(super) fn waits(&self) -> &Semaphore {
        &self.0.waits
    }

    /// Exports that are being made.
    pub(super) fn exports(&self) -> &ExportQueue {
        &self.0.exports
    }

    /// Waits for changes of jobs.
    pub(super) fn watcher(&self) -> &Watcher {
        &self.0.watcher
    }

    /// Cancelled once the server shuts down: what waits for something should then answer at once.
    pub(super) fn draining(&self) -> &CancellationToken {
        &self.0.draining
    }

    pub(super) fn stream_places(&self) -> &StreamPlaces {
        &self.0.stream_places
    }

    pub(super) fn is_draining(&self) -> bool {
        self.0.draining.is_cancelled()
    }
}
