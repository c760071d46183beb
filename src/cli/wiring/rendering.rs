//! The engine of a service: in this process, or with viewer processes.

use std::{error::Error, sync::Arc};

use tcgs::{
    domain::{MemoryLimits, Problem, SystemClock},
    engine::{LocalEngine, SceneEngine},
    gpu::{AdapterChoice, AdapterReport},
    ingest::DatasetChecker,
    pipeline::{Machine, exported::Refiner},
    store::Store,
    viewers::{RemoteEngine, ViewerPool},
};
use tokio::{runtime::Handle, task::JoinHandle};
use tokio_util::sync::CancellationToken;

/// What renders the views and exports of a process.
pub(super) struct Rendering {
    pub(super) engine: Arc<dyn SceneEngine>,
    /// Ends when the process shuts down.
    pub(super) watch: Option<JoinHandle<()>>,
}

/// Renders in this process.
pub(super) fn local_rendering(
    adapter: &AdapterChoice,
    view_memory: u64,
    job_memory: MemoryLimits,
    checker: DatasetChecker,
) -> Result<Rendering, Problem> {
    let (views, _) = super::views(adapter, view_memory)?;
    // Workers open the same adapter.
    let machine = Machine { adapter: AdapterReport::of(adapter)?, memory: job_memory };
    let engine = LocalEngine::new(checker, views)
        .with_machine(machine)
        .with_refiner(Refiner::new(adapter.clone(), view_memory));
    Ok(Rendering { engine: Arc::new(engine), watch: None })
}

/// Leaves rendering to viewer processes.
pub(super) async fn remote_rendering(
    store: &Store,
    shutdown: &CancellationToken,
    checker: DatasetChecker,
) -> Result<Rendering, Box<dyn Error + Send + Sync>> {
    let pool = Arc::new(ViewerPool::new(store.clone(), Arc::new(SystemClock), Handle::current())?);
    pool.refresh().await;
    let watch = tokio::spawn(Arc::clone(&pool).watch(shutdown.clone()));
    Ok(Rendering { engine: Arc::new(RemoteEngine::new(checker, pool)), watch: Some(watch) })
}
