//! Starts the two kinds of process: the API with its supervised workers, and a worker.
//!
//! On a signal both stop in order: they take no new work, finish open work or return it to the queue, then close the database. A second
//! signal ends them at once; leases and transactions keep everything that was acknowledged.

use std::{
    ffi::OsString,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use futures_util::future::OptionFuture;
use tcgs::{
    domain::{
        Bytes, MemoryLimits, OutboundPolicy, Problem, ProblemType, ProjectLimits, SystemClock, SystemRandom,
    },
    gpu::{AdapterChoice, driver_cache},
    http::{self, HttpConfig, Services},
    https::ExtraRoots,
    ingest::DatasetChecker,
    pipeline::ReferenceViews,
    store::{
        BlobPlace, Blobs, DATABASE, PostgresUrl, QueuePolicy, SchemaChange, Store,
        garbage::{GarbagePolicy, collect_garbage},
    },
    webhooks::{self, DeliveryConfig, Sender},
    worker::{self, WorkerConfig, supervise},
};

use super::{
    first_key::FirstKey,
    private,
    rendering::{Rendering, local_rendering, remote_rendering},
    runtime::{cannot_listen, run_until_stopped, runtime, stop_on_signals, unavailable},
};
use crate::cli::{CliError, camera_search::CameraFlags, files, logging::Format, storage::Storage};

/// Name of the folder for the checkpoints of running jobs in the data folder.
const CHECKPOINTS: &str = "checkpoints";

/// Name of the folder in the data folder with the lock files of live workers.
const WORKERS: &str = "workers";

/// Name of the folder in the data folder for the drivers' shader cache, if the user has no home.
const DRIVER_CACHE: &str = "driver-cache";

/// How long an endpoint may take to answer a webhook.
const WEBHOOK_TIMEOUT: Duration = Duration::from_secs(15);

/// Options of the service process.
#[derive(Debug, Clone)]
pub(crate) struct ServeOptions {
    pub(crate) http: HttpConfig,
    /// Limits of projects that have none of their own.
    pub(crate) limits: ProjectLimits,
    pub(crate) storage: Storage,
    /// File of the first key of a service that has none.
    pub(crate) first_key_file: Option<PathBuf>,
    pub(crate) adapter: AdapterChoice,
    /// Memory of each worker.
    pub(crate) memory: MemoryLimits,
    /// Bytes of device memory for views in this process.
    pub(crate) view_memory: u64,
    /// Whether viewer processes render instead of this one.
    pub(crate) remote_views: bool,
    /// Weights of LPIPS, for the workers.
    pub(crate) lpips: Option<PathBuf>,
    /// Programs that find cameras, for the workers.
    pub(crate) cameras: CameraFlags,
    /// Worker processes to start.
    pub(crate) workers: u16,
    /// Niceness of workers.
    pub(crate) worker_nice: u8,
    /// Where webhooks may be sent.
    pub(crate) webhook_targets: OutboundPolicy,
    /// PEM file of certificate authorities to trust for them, in addition to the system's.
    pub(crate) webhook_roots: Option<PathBuf>,
    /// How long an ended job is kept; for ever if `None`.
    pub(crate) keep_jobs: Option<Duration>,
    /// Log format of this process and its workers.
    pub(crate) log_format: Format,
}

/// Options of a worker process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct WorkerOptions {
    /// The data of the service.
    pub(crate) storage: Storage,
    pub(crate) adapter: AdapterChoice,
    pub(crate) memory: MemoryLimits,
    /// Weights of LPIPS.
    pub(crate) lpips: Option<PathBuf>,
    /// Programs that find cameras.
    pub(crate) cameras: CameraFlags,
    /// Most running jobs of a project without a limit of its own.
    pub(crate) max_running_jobs: Option<u32>,
    /// Whether to stop when standard input closes, which it does when the parent process dies.
    pub(crate) stop_with_parent: bool,
    /// Time between two checkpoints, if it is not the usual one.
    pub(crate) checkpoint_every: Option<Duration>,
}

/// Runs the service until a signal comes.
pub(crate) fn serve(options: ServeOptions) -> Result<(), CliError> {
    let mut config = options.http.clone();
    config.limits.webhook_targets = options.webhook_targets;
    if options.remote_views {
        config.limits = config.limits.for_remote_views();
    }
    run_until_stopped(async {
        let has_keys = has_keys(&options.storage).await?;
        let first_key = options.first_key_file.as_deref().filter(|_| !has_keys);
        let first_key = first_key.map(FirstKey::find).transpose()?;
        let has_keys = has_keys || first_key.is_some();
        config.check_exposure(has_keys).map_err(|error| CliError::Usage(format!("--listen: {error}")))?;
        // Fails here rather than in every worker.
        super::lpips(options.lpips.as_deref())?;
        let roots = webhook_roots(options.webhook_roots.as_deref())?;
        // The adapter and the address come before the database: a service that cannot start must not migrate the schema of one that runs.
        let checker = || DatasetChecker::new(config.limits.checks, config.limits.check_time);
        let local = match options.remote_views {
            true => None,
            false => Some(local_rendering(&options.adapter, options.view_memory, options.memory, checker())?),
        };
        let listeners = http::bind(&config, has_keys).await.map_err(|error| cannot_listen(&error))?;
        let store = open_store(&options.storage, options.limits, OlderSchema::Migrate).await?;
        if let Some(first_key) = first_key {
            first_key.create(&store).await?;
        }
        let blobs = open_blobs(&options.storage, &store).await?;
        private::close_all(&options.storage.data);
        let shutdown = stop_on_signals()?;
        let Rendering { engine, watch } = match local {
            Some(local) => local,
            None => {
                remote_rendering(&store, &shutdown, checker()).await.map_err(|error| unavailable(&*error))?
            }
        };

        let mut children = supervise::SuperviseConfig::this_program(
            worker_arguments(&options),
            usize::from(options.workers),
        )
        .map_err(|error| unavailable(&error))?;
        children.environment = driver_cache_in(&options.storage.data);
        // Not an argument, which every user of the machine can read: it may hold a password.
        children.environment.extend(options.storage.database.iter().map(database_variable));
        children.liveness_dir = Some(options.storage.data.join(WORKERS));
        let supervisor = supervise::supervise(children, store.clone(), shutdown.clone());
        let live_workers = supervisor.live_workers();
        let housekeeping = tokio::spawn(collect_garbage(
            store.clone(),
            blobs.clone(),
            Arc::new(SystemClock),
            GarbagePolicy { keep_jobs: options.keep_jobs, ..GarbagePolicy::default() },
            shutdown.clone(),
        ));
        let checkpoints = options.storage.data.join(CHECKPOINTS);
        let sender = Sender::new(options.webhook_targets, webhooks::system_lookup(), WEBHOOK_TIMEOUT, &roots)
            .map_err(|error| unavailable(&*error))?;
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
            entropy: Arc::new(SystemRandom),
            engine,
            workers: Arc::new(supervise::SupervisedWorkers::new(live_workers, checkpoints)),
        };
        let address = listeners.address().unwrap_or(options.http.listen);
        if let Ok(Some(address)) = listeners.metrics_address() {
            tracing::info!(metrics_address = %address, "metrics are on http://{address}/metrics");
        }
        tracing::info!(%address, data = %options.storage.data.display(), database = %options.storage, "serving on http://{address}");
        http::serve(listeners, config, services, shutdown).await;
        supervisor.stopped().await;
        if let Err(error) = housekeeping.await {
            tracing::warn!(%error, "garbage collection stopped early");
        }
        if let Err(error) = delivering.await {
            tracing::warn!(%error, "webhook delivery stopped early");
        }
        if let Some(Err(error)) = OptionFuture::from(watch).await {
            tracing::warn!(%error, "the list of viewers was no longer read");
        }
        store.close().await;
        Ok(())
    })
}

/// Runs a worker until a signal comes, or its parent dies.
pub(crate) fn worker(options: WorkerOptions) -> Result<(), CliError> {
    run_until_stopped(async {
        let lpips = super::lpips(options.lpips.as_deref())?;
        let runner = super::runner(&options.adapter, options.memory, options.storage.data.clone(), lpips);
        // One small view: the reference takes a core.
        let reference = ReferenceViews { views: 1, max_side: 256 };
        let every = options.checkpoint_every.and_then(|every| every.try_into().ok());
        let runner = runner.with_pictures().with_reference(Some(reference)).with_checkpoints_every(every);
        let runner = Arc::new(runner);
        // The service has migrated the schema; a worker of another version must not.
        let limits = ProjectLimits { max_running_jobs: options.max_running_jobs, ..ProjectLimits::default() };
        let store = open_store(&options.storage, limits, OlderSchema::Refuse).await?;
        let blobs = open_blobs(&options.storage, &store).await?;
        let shutdown = stop_on_signals()?;
        if options.stop_with_parent {
            worker::stop_when_stdin_closes(shutdown.clone()).map_err(|error| unavailable(&error))?;
        }
        let checkpoints = Some(options.storage.data.join(CHECKPOINTS));
        // Only a supervisor reads it; other workers are known by their leases.
        let liveness_dir = options.stop_with_parent.then(|| options.storage.data.join(WORKERS));
        let cameras = Some(options.cameras.search(Bytes(options.memory.host)));
        let config = WorkerConfig { checkpoints, liveness_dir, cameras, ..WorkerConfig::from_environment() };
        let outcome = worker::serve(store.clone(), blobs, runner, config, shutdown).await;
        store.close().await;
        outcome.map_err(|error| CliError::from(Problem::new(ProblemType::Stalled, error.to_string())))
    })
}

/// Brings the schema of a service's database up to date.
pub(crate) fn migrate(storage: &Storage) -> Result<SchemaChange, CliError> {
    runtime()?.block_on(async {
        private_folder(&storage.data)?;
        let migrated =
            Store::migrate(storage.location(), Arc::new(SystemClock), QueuePolicy::default()).await;
        let (store, change) = migrated.map_err(|error| unavailable(&error))?;
        store.close().await;
        Ok(change)
    })
}

/// How to treat a database of an earlier version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OlderSchema {
    Migrate,
    Refuse,
}

/// The database of a service, with limits for projects that have none of their own.
pub(super) async fn open_store(
    storage: &Storage,
    limits: ProjectLimits,
    older: OlderSchema,
) -> Result<Store, CliError> {
    private_folder(&storage.data)?;
    let (database, clock) = (storage.location(), Arc::new(SystemClock));
    let policy = QueuePolicy { limits, ..QueuePolicy::default() };
    let store = match older {
        OlderSchema::Migrate => Store::open(database, clock, policy).await,
        OlderSchema::Refuse => Store::open_current(database, clock, policy).await,
    };
    store.map_err(|error| unavailable(&error))
}

/// The blobs of a service, in the place that its database knows.
pub(super) async fn open_blobs(storage: &Storage, store: &Store) -> Result<Blobs, CliError> {
    let opened = async {
        let Some(bucket) = &storage.blobs else {
            store.claim_place(BlobPlace::Folder).await?;
            return Blobs::open(&storage.data);
        };
        Blobs::open_bucket(&storage.data, bucket.connect()?, store.clone()).await
    };
    opened.await.map_err(|error| unavailable(&error))
}

/// Creates the folder and makes it private.
fn private_folder(data: &Path) -> Result<(), CliError> {
    private::create(data).map_err(|error| CliError::unwritable(data, &error))?;
    private::close(data, &["", "-wal", "-shm", ".lock"].map(|suffix| format!("{DATABASE}{suffix}")));
    Ok(())
}

/// The authorities in a file, if one is named.
fn webhook_roots(path: Option<&Path>) -> Result<ExtraRoots, CliError> {
    let Some(path) = path else { return Ok(ExtraRoots::default()) };
    ExtraRoots::from_pem(&files::read(path)?)
        .map_err(|error| CliError::Usage(format!("--webhooks-ca: {} {error}", path.display())))
}

/// Whether the database has keys; a missing file is not created, and an older schema not migrated.
async fn has_keys(storage: &Storage) -> Result<bool, CliError> {
    if storage.file().is_some_and(|file| !file.exists()) {
        return Ok(false);
    }
    Store::has_keys_in(storage.location(), Arc::new(SystemClock)).await.map_err(|error| unavailable(&error))
}

/// The environment variables of the drivers' shader cache.
fn driver_cache_in(data: &Path) -> Vec<(OsString, OsString)> {
    // The child may run elsewhere than here.
    let folder = std::path::absolute(data).unwrap_or_else(|_| data.to_owned()).join(DRIVER_CACHE);
    let environment = driver_cache(&|name| std::env::var_os(name), &folder);
    if !environment.is_empty()
        && let Err(error) = fs::create_dir_all(&folder)
    {
        tracing::warn!(folder = %folder.display(), "drivers cannot keep compiled kernels: {error}");
    }
    environment
}

/// The variable that tells workers of the database.
fn database_variable(url: &PostgresUrl) -> (OsString, OsString) {
    ("TCGS_DATABASE".into(), url.expose().into())
}

fn worker_arguments(options: &ServeOptions) -> Vec<OsString> {
    let mut arguments = vec![
        "worker".into(),
        "--data".into(),
        options.storage.data.clone().into(),
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
    if let Some(bucket) = &options.storage.blobs {
        arguments.extend(["--blobs".into(), bucket.to_string().into()]);
    }
    if let Some(gpu) = options.memory.gpu {
        arguments.extend(["--gpu-memory".into(), gpu.to_string().into()]);
    }
    if let Some(max) = options.limits.max_running_jobs {
        arguments.extend(["--max-running-jobs".into(), max.to_string().into()]);
    }
    let CameraFlags { poses_python, ffmpeg } = &options.cameras;
    for (flag, file) in [("--lpips", &options.lpips), ("--poses-python", poses_python), ("--ffmpeg", ffmpeg)]
    {
        if let Some(file) = file {
            arguments.extend([flag.into(), file.clone().into()]);
        }
    }
    arguments
}
