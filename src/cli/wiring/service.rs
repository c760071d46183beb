//! Assembles the two kinds of process: the API with its supervised workers, and a worker.
//!
//! Both stop in order when a signal asks them to: no new work, open work to its end or back to the queue, then the
//! database. A second signal ends them at once, which loses nothing that was acknowledged: leases and transactions see to that.

use std::{
    error::Error,
    ffi::OsString,
    fs, io,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use tcgs::{
    domain::{
        Camera, Digest, KeyLimits, MemoryLimits, NamedCamera, OutboundPolicy, Problem, ProblemType,
        SceneFormat, Split, SystemClock, SystemEntropy,
    },
    gpu::{AdapterChoice, driver_cache},
    http::{self, ExportedScene, HttpConfig, Services, WorkerCounts},
    https::ExtraRoots,
    ingest::DatasetChecker,
    pipeline::scene_file,
    render::{RenderViews, views::Viewable},
    store::{
        Blobs, Keys as _, QueuePolicy, SchemaChange, SqliteStore,
        garbage::{GarbagePolicy, collect_garbage},
    },
    webhooks::{self, DeliveryConfig, Sender},
    worker::{self, WorkerConfig, supervise},
};
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

use super::{Renderer, private};
use crate::cli::{Failure, files, logging::Format};

/// Name of the database in the data folder.
const DATABASE: &str = "tcgs.sqlite";

/// Name of the folder for the checkpoints of running jobs in the data folder.
const CHECKPOINTS: &str = "checkpoints";

/// Name of the folder in the data folder where supervised workers show that they are alive.
const WORKERS: &str = "workers";

/// Name of the folder in the data folder for what drivers keep of kernels, where their user has no home.
const DRIVER_CACHE: &str = "driver-cache";

/// How long an endpoint may take to answer a webhook.
const WEBHOOK_TIMEOUT: Duration = Duration::from_secs(15);

/// Datasets that are checked at a time: one that takes its time does not hold up all others, and the memory of all checks
/// together stays below 256 MiB.
const CHECKS: usize = 2;

/// How long the check of a dataset may take, and how long another waits for its turn: enough for some thousand photographs on
/// a disk that has to seek for each.
const CHECK_TIME: Duration = Duration::from_secs(120);

/// Where a service listens and keeps its data.
#[derive(Debug, Clone)]
pub(crate) struct ServeOptions {
    pub(crate) http: HttpConfig,
    /// How much a key may take that has no limits of its own.
    pub(crate) limits: KeyLimits,
    pub(crate) data: PathBuf,
    pub(crate) adapter: AdapterChoice,
    /// What each worker may take.
    pub(crate) memory: MemoryLimits,
    /// Bytes on the device that views may take in this process.
    pub(crate) view_memory: u64,
    /// Weights of LPIPS, for the workers.
    pub(crate) lpips: Option<PathBuf>,
    /// Worker processes to start.
    pub(crate) workers: u16,
    /// How far they let other processes go first.
    pub(crate) worker_nice: u8,
    /// Where webhooks may be sent.
    pub(crate) webhook_targets: OutboundPolicy,
    /// PEM file of authorities that are trusted there besides the system's.
    pub(crate) webhook_roots: Option<PathBuf>,
    /// How this process logs, and so its workers.
    pub(crate) log_format: Format,
}

/// Where a worker finds its queue.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct WorkerOptions {
    /// The data folder of the service.
    pub(crate) data: PathBuf,
    pub(crate) adapter: AdapterChoice,
    pub(crate) memory: MemoryLimits,
    /// Weights of LPIPS.
    pub(crate) lpips: Option<PathBuf>,
    /// Whether to stop when standard input closes, which it does when the parent process dies.
    pub(crate) stop_with_parent: bool,
}

/// Runs the service until a signal comes.
pub(crate) fn serve(options: ServeOptions) -> Result<(), Failure> {
    let mut config = options.http.clone();
    config.limits.webhook_targets = options.webhook_targets;
    runtime()?.block_on(async {
        let has_keys = has_keys(&options.data).await?;
        config.check_exposure(has_keys).map_err(|fault| Failure::Usage(format!("--listen: {fault}")))?;
        // Before any worker starts, which would find the same faults.
        super::lpips(options.lpips.as_deref())?;
        let roots = webhook_roots(options.webhook_roots.as_deref())?;
        let (renderer, _) = super::views(&options.adapter, options.view_memory)?;
        let listeners = http::bind(&config, has_keys).await.map_err(|fault| unavailable(&fault))?;
        let store = open_store(&options.data, options.limits, OlderSchema::Migrate).await?;
        let blobs = open_blobs(&options.data)?;
        private::close_all(&options.data);
        let shutdown = stop_on_signals()?;

        let mut children = supervise::SuperviseConfig::this_program(
            worker_arguments(&options),
            usize::from(options.workers),
        )
        .map_err(|fault| unavailable(&fault))?;
        children.environment = driver_cache_in(&options.data);
        children.liveness_dir = Some(options.data.join(WORKERS));
        let supervisor = supervise::supervise(children, store.clone(), shutdown.clone());
        let live_workers = supervisor.live_workers();
        let housekeeping = tokio::spawn(collect_garbage(
            store.clone(),
            blobs.clone(),
            Arc::new(SystemClock),
            GarbagePolicy::default(),
            shutdown.clone(),
        ));
        let checkpoints = options.data.join(CHECKPOINTS);
        let sender = Sender::new(options.webhook_targets, webhooks::system_lookup(), WEBHOOK_TIMEOUT, &roots)
            .map_err(|fault| unavailable(&*fault))?;
        let delivering = tokio::spawn(webhooks::deliver(
            store.clone(),
            sender,
            DeliveryConfig::default(),
            shutdown.clone(),
        ));
        let services = Services {
            store: store.clone(),
            blobs,
            clock: Arc::new(SystemClock),
            entropy: Arc::new(SystemEntropy),
            check: {
                let checks = DatasetChecker::new(CHECKS, CHECK_TIME);
                Arc::new(move |archive: &Path| checks.check(archive))
            },
            load: Arc::new(|bytes: &[u8]| {
                let file = scene_file::read(bytes)?;
                Ok(Viewable { scene: file.scene, background: file.background })
            }),
            export: {
                let views = Arc::clone(&renderer);
                Arc::new(move |bytes, format, cameras| export(&views, bytes, format, cameras))
            },
            renderer,
            forget: Arc::new(move |job| worker::forget_checkpoints(&checkpoints, job)),
            workers: Arc::new(move || WorkerCounts {
                expected: live_workers.expected(),
                alive: live_workers.pids().len(),
            }),
        };
        let address = listeners.address().unwrap_or(options.http.listen);
        if let Ok(Some(address)) = listeners.metrics_address() {
            tracing::info!(metrics_address = %address, "metrics are on http://{address}/metrics");
        }
        tracing::info!(%address, data = %options.data.display(), "serving on http://{address}");
        http::serve(listeners, config, services, shutdown).await;
        supervisor.stopped().await;
        if let Err(fault) = housekeeping.await {
            tracing::warn!(%fault, "clearing away ended early");
        }
        if let Err(fault) = delivering.await {
            tracing::warn!(%fault, "the delivery of webhooks ended early");
        }
        store.close().await;
        Ok(())
    })
}

/// Runs a worker until a signal comes, or its parent dies.
pub(crate) fn worker(options: WorkerOptions) -> Result<(), Failure> {
    let runtime = runtime()?;
    let outcome = runtime.block_on(async {
        let lpips = super::lpips(options.lpips.as_deref())?;
        let runner = super::job_runner(&options.adapter, options.memory, options.data.clone(), lpips);
        // A service whose worker this is has brought the schema up to date; one of another version is left alone.
        let store = open_store(&options.data, KeyLimits::default(), OlderSchema::Refuse).await?;
        let blobs = open_blobs(&options.data)?;
        let shutdown = stop_on_signals()?;
        if options.stop_with_parent {
            worker::stop_when_stdin_closes(shutdown.clone()).map_err(|fault| unavailable(&fault))?;
        }
        let checkpoints = Some(options.data.join(CHECKPOINTS));
        // Its supervisor looks there; who has none is known by its lease alone.
        let liveness_dir = options.stop_with_parent.then(|| options.data.join(WORKERS));
        let config = WorkerConfig { checkpoints, liveness_dir, ..WorkerConfig::from_environment() };
        let outcome = worker::serve(store.clone(), blobs, runner, config, shutdown).await;
        store.close().await;
        outcome.map_err(|fault| Failure::from(Problem::new(ProblemType::Stalled, fault.to_string())))
    });
    // A run that did not stop is still on its thread; waiting for it here would undo giving up on it.
    runtime.shutdown_background();
    outcome
}

/// Brings the schema of the database in a data folder up to date.
pub(crate) fn migrate(data: &Path) -> Result<SchemaChange, Failure> {
    runtime()?.block_on(async {
        private_folder(data)?;
        let database = data.join(DATABASE);
        let migrated = SqliteStore::migrate(&database, Arc::new(SystemClock), QueuePolicy::default()).await;
        let (store, change) = migrated.map_err(|fault| unavailable(&fault))?;
        store.close().await;
        Ok(change)
    })
}

/// What is done with a database that an earlier version has made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OlderSchema {
    Migrate,
    Refuse,
}

/// The database in a data folder, with limits for keys that have none of their own.
pub(super) async fn open_store(
    data: &Path,
    limits: KeyLimits,
    older: OlderSchema,
) -> Result<Arc<SqliteStore>, Failure> {
    private_folder(data)?;
    let (database, clock) = (data.join(DATABASE), Arc::new(SystemClock));
    let policy = QueuePolicy { limits, ..QueuePolicy::default() };
    let store = match older {
        OlderSchema::Migrate => SqliteStore::open(&database, clock, policy).await,
        OlderSchema::Refuse => SqliteStore::open_current(&database, clock, policy).await,
    };
    store.map(Arc::new).map_err(|fault| unavailable(&fault))
}

fn open_blobs(data: &Path) -> Result<Blobs, Failure> {
    Blobs::open(data).map_err(|fault| unavailable(&fault))
}

/// Makes the folder, and sees to it that nobody else can read what it holds.
fn private_folder(data: &Path) -> Result<(), Failure> {
    private::create(data).map_err(|fault| Failure::unwritable(data, &fault))?;
    private::close(data, &["", "-wal", "-shm", ".lock"].map(|suffix| format!("{DATABASE}{suffix}")));
    Ok(())
}

/// The authorities in a file, if one is named.
fn webhook_roots(path: Option<&Path>) -> Result<ExtraRoots, Failure> {
    let Some(path) = path else { return Ok(ExtraRoots::default()) };
    ExtraRoots::from_pem(&files::read(path)?)
        .map_err(|fault| Failure::Usage(format!("--webhooks-ca: {} {fault}", path.display())))
}

/// Whether the database knows of keys; where there is none yet, none is made to find that out.
async fn has_keys(data: &Path) -> Result<bool, Failure> {
    if !data.join(DATABASE).exists() {
        return Ok(false);
    }
    let store = open_store(data, KeyLimits::default(), OlderSchema::Migrate).await?;
    let has_keys = store.has_keys().await.map_err(|fault| unavailable(&fault))?;
    store.close().await;
    Ok(has_keys)
}

/// Highest degree of the spherical harmonics of scenes that are exported on demand.
const EXPORT_DEGREE: u8 = 3;

/// A finished scene in another format, made to look alike from the training cameras, or from all around where there are none.
fn export(
    views: &Arc<dyn RenderViews>,
    bytes: &[u8],
    format: SceneFormat,
    cameras: &[NamedCamera],
) -> Result<ExportedScene, Problem> {
    let file = scene_file::read(bytes)?;
    let trained = of_split(cameras, Split::Train);
    let from = (!trained.is_empty()).then_some(&*trained);
    let exported = super::export(&file, format, EXPORT_DEGREE, from)?;
    let gaussians = u64::try_from(exported.gaussians).unwrap_or(u64::MAX);
    let held_out = of_split(cameras, Split::Test);
    let cameras = if held_out.is_empty() { trained } else { held_out };
    // The key of its views too, so that a scene that is being looked at is not loaded again.
    let source = Renderer::over(Arc::clone(views), Digest::of(bytes), file);
    let fidelity = super::fidelity(&source, &exported.bytes, &cameras).unwrap_or_else(|fault| {
        tracing::warn!("how alike an export looks cannot be told: {fault}");
        None
    });
    Ok(ExportedScene { bytes: exported.bytes, gaussians, sh_degree: exported.degree, fidelity })
}

fn of_split(cameras: &[NamedCamera], split: Split) -> Vec<Camera> {
    cameras.iter().filter(|camera| camera.split == split).map(|camera| camera.camera).collect()
}

/// The environment that lets workers find compiled kernels again.
fn driver_cache_in(data: &Path) -> Vec<(OsString, OsString)> {
    // The child may run elsewhere than here.
    let folder = std::path::absolute(data).unwrap_or_else(|_| data.to_owned()).join(DRIVER_CACHE);
    let environment = driver_cache(&|name| std::env::var_os(name), &folder);
    if !environment.is_empty()
        && let Err(fault) = fs::create_dir_all(&folder)
    {
        tracing::warn!(folder = %folder.display(), "drivers cannot keep compiled kernels: {fault}");
    }
    environment
}

fn worker_arguments(options: &ServeOptions) -> Vec<OsString> {
    let mut arguments = vec![
        "worker".into(),
        "--data".into(),
        options.data.clone().into(),
        "--adapter".into(),
        options.adapter.to_string().into(),
        "--log-format".into(),
        options.log_format.to_string().into(),
        "--stop-with-parent".into(),
        "--host-memory".into(),
        options.memory.host.to_string().into(),
        "--worker-nice".into(),
        options.worker_nice.to_string().into(),
    ];
    if let Some(gpu) = options.memory.gpu {
        arguments.extend(["--gpu-memory".into(), gpu.to_string().into()]);
    }
    if let Some(lpips) = &options.lpips {
        arguments.extend(["--lpips".into(), lpips.clone().into()]);
    }
    arguments
}

pub(super) fn runtime() -> Result<Runtime, Failure> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(|fault| unavailable(&fault))
}

/// How long after a signal another one is taken for the same wish: wrappers such as `timeout` send each twice.
const ONE_WISH: Duration = Duration::from_millis(500);

/// Cancelled by the first interrupt or termination signal. A second ends the process at once.
fn stop_on_signals() -> Result<CancellationToken, Failure> {
    let stop = CancellationToken::new();
    let cancel = stop.clone();
    // Heard from here on, not only once the task runs.
    let mut signals = Signals::listen().map_err(|fault| unavailable(&fault))?;
    tokio::spawn(async move {
        signals.next().await;
        tracing::info!("stopping; another signal ends this at once");
        cancel.cancel();
        tokio::time::sleep(ONE_WISH).await;
        // Those that came meanwhile are not heard by new listeners.
        match Signals::listen() {
            Ok(mut signals) => {
                let status = signals.next().await;
                tracing::warn!(
                    "ending at once; jobs under way go back to the queue, at the latest when their leases run out"
                );
                std::process::exit(status);
            }
            Err(fault) => tracing::warn!(%fault, "a second signal cannot be received"),
        }
    });
    Ok(stop)
}

/// The signals that ask a process to stop.
#[cfg(unix)]
struct Signals {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
}

#[cfg(unix)]
impl Signals {
    fn listen() -> io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self { interrupt: signal(SignalKind::interrupt())?, terminate: signal(SignalKind::terminate())? })
    }

    /// Waits for one, and returns the exit status of a process that it ends, as shells have it.
    async fn next(&mut self) -> i32 {
        tokio::select! {
            _ = self.interrupt.recv() => 128 + 2,
            _ = self.terminate.recv() => 128 + 15,
        }
    }
}

/// The signal that asks a process to stop.
#[cfg(windows)]
struct Signals(tokio::signal::windows::CtrlC);

#[cfg(windows)]
impl Signals {
    fn listen() -> io::Result<Self> {
        tokio::signal::windows::ctrl_c().map(Self)
    }

    /// Waits for one, and returns the exit status of a process that it ends.
    async fn next(&mut self) -> i32 {
        self.0.recv().await;
        130
    }
}

/// Something that this process needs is not to be had; the fault with its causes.
pub(super) fn unavailable(fault: &(dyn Error + 'static)) -> Failure {
    let mut detail = fault.to_string();
    let mut source = fault.source();
    while let Some(cause) = source {
        detail = format!("{detail}: {cause}");
        source = cause.source();
    }
    Problem::new(ProblemType::Unavailable, detail).into()
}
