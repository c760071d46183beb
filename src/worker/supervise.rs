//! Restarts worker processes.
//!
//! Training runs in a process of its own because its usual failures (the kernel's out-of-memory killer, a driver's crash) end a whole
//! process, which must not be the one that serves requests. A child's standard input is a pipe that the supervisor holds open: closing it
//! asks the child to drain and exit, and since the system closes it when the parent dies, no child outlives its parent.

use std::{
    collections::BTreeSet,
    ffi::OsString,
    path::PathBuf,
    pin::pin,
    process::{ExitStatus, Stdio},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use tokio::{
    process::{Child, Command},
    sync::watch,
    task::JoinSet,
    time::{Instant, sleep, timeout},
};
use tokio_util::sync::CancellationToken;

use super::{WORKER_ID_VARIABLE, checkpoints, liveness, new_worker_id};
use crate::{
    domain::{JobId, WorkerCounts, Workers},
    store::{Store, WorkerDeath},
};

/// Which program to run as workers, and its timeouts.
#[derive(Debug, Clone)]
pub struct SuperviseConfig {
    /// The worker's program.
    pub program: PathBuf,
    pub arguments: Vec<OsString>,
    /// Variables added to its environment.
    pub environment: Vec<(OsString, OsString)>,
    /// Number of workers.
    pub workers: usize,
    /// How long a child may take to drain before it is killed; above [`super::WorkerConfig::drain`].
    pub grace: Duration,
    /// Pause before a child is restarted after an early death; doubles with each further one.
    pub backoff_base: Duration,
    /// Longest pause.
    pub backoff_cap: Duration,
    /// A death after this time is not early.
    pub healthy_after: Duration,
    /// Pause after a child's end before its job is blamed: if a whole process group is killed, this process ends next.
    pub blame_delay: Duration,
    /// Folder of the children's lock files ([`super::WorkerConfig::liveness_dir`]), if they have any.
    pub liveness_dir: Option<PathBuf>,
    /// Pause between two searches for dead workers: on a busy machine a killed process holds its lock for a while.
    pub liveness_interval: Duration,
}

impl SuperviseConfig {
    /// `workers` copies of this program with `arguments`.
    ///
    /// # Errors
    /// If the running program's path is unknown.
    pub fn this_program(arguments: Vec<OsString>, workers: usize) -> std::io::Result<Self> {
        Ok(Self::program(std::env::current_exe()?, arguments, workers))
    }

    /// `workers` copies of `program` with `arguments`.
    #[must_use]
    pub fn program(program: PathBuf, arguments: Vec<OsString>, workers: usize) -> Self {
        Self {
            program,
            arguments,
            environment: Vec::new(),
            workers,
            grace: Duration::from_secs(25),
            backoff_base: Duration::from_millis(250),
            backoff_cap: Duration::from_secs(30),
            healthy_after: Duration::from_secs(60),
            blame_delay: Duration::from_millis(250),
            liveness_dir: None,
            liveness_interval: Duration::from_secs(2),
        }
    }
}

/// The workers that this supervisor has started: their deaths are its own to classify, however soon their locks are free.
#[derive(Debug, Default)]
struct Started(Mutex<BTreeSet<String>>);

impl Started {
    fn ids(&self) -> MutexGuard<'_, BTreeSet<String>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Ends the attempts of workers of earlier services whose process is gone.
    async fn expire_earlier_workers(&self, config: &SuperviseConfig, store: &Store) {
        if let Some(folder) = &config.liveness_dir {
            liveness::expire_dead_workers(folder, store, &|id| !self.ids().contains(id)).await;
        }
    }
}

/// A running supervisor.
#[derive(Debug)]
pub struct Supervisor {
    children: Vec<watch::Receiver<Option<u32>>>,
    tasks: JoinSet<()>,
}

/// A cheap view of the live children, for readiness checks.
#[derive(Default, Debug, Clone)]
pub struct LiveWorkers(Vec<watch::Receiver<Option<u32>>>);

impl LiveWorkers {
    /// Number of children that should live.
    #[must_use]
    pub fn expected(&self) -> usize {
        self.0.len()
    }

    /// Process ids of the live ones.
    #[must_use]
    pub fn pids(&self) -> Vec<u32> {
        self.0.iter().filter_map(|child| *child.borrow()).collect()
    }
}

/// The workers of a supervisor, with the folder of their checkpoints.
pub struct SupervisedWorkers {
    live: LiveWorkers,
    checkpoints: PathBuf,
}

impl SupervisedWorkers {
    /// Of live workers that keep checkpoints in this folder.
    #[must_use]
    pub fn new(live: LiveWorkers, checkpoints: PathBuf) -> Self {
        Self { live, checkpoints }
    }
}

impl Workers for SupervisedWorkers {
    fn counts(&self) -> WorkerCounts {
        WorkerCounts { expected: self.live.expected(), alive: self.live.pids().len() }
    }

    fn forget(&self, job: JobId) {
        checkpoints::forget(&self.checkpoints, job);
    }
}

/// Starts the workers, and restarts them until `shutdown`.
#[must_use]
pub fn supervise(config: SuperviseConfig, store: Store, shutdown: CancellationToken) -> Supervisor {
    let config = Arc::new(config);
    let started = Arc::new(Started::default());
    let mut tasks = JoinSet::new();
    let children = (0..config.workers)
        .map(|_| {
            let (pid, watched) = watch::channel(None);
            tasks.spawn(keep_alive(
                Arc::clone(&config),
                store.clone(),
                Arc::clone(&started),
                pid,
                shutdown.clone(),
            ));
            watched
        })
        .collect();
    Supervisor { children, tasks }
}

impl Supervisor {
    /// The live children.
    #[must_use]
    pub fn live_workers(&self) -> LiveWorkers {
        LiveWorkers(self.children.clone())
    }

    /// Waits until every child has exited after `shutdown`.
    pub async fn stopped(mut self) {
        while self.tasks.join_next().await.is_some() {}
    }
}

async fn keep_alive(
    config: Arc<SuperviseConfig>,
    store: Store,
    started: Arc<Started>,
    pid: watch::Sender<Option<u32>>,
    shutdown: CancellationToken,
) {
    let mut early_deaths = 0_u32;
    while !shutdown.is_cancelled() {
        started.expire_earlier_workers(&config, &store).await;
        let id = new_worker_id();
        started.ids().insert(id.clone());
        let born = Instant::now();
        match start(&config, &id) {
            Ok(mut child) => {
                pid.send_replace(child.id());
                let status = {
                    let mut waiting = pin!(wait_or_stop(&config, &mut child, &shutdown));
                    loop {
                        tokio::select! {
                            status = &mut waiting => break status,
                            () = sleep(config.liveness_interval) => {
                                started.expire_earlier_workers(&config, &store).await;
                            }
                        }
                    }
                };
                pid.send_replace(None);
                tracing::info!(worker = id, ?status, "worker {id} has ended");
                let death = classify_death(&config, &shutdown).await;
                if liveness::expire_worker(&store, &id, death).await
                    && let Some(folder) = &config.liveness_dir
                {
                    // One that was killed has left its file.
                    liveness::remove(folder, &id);
                }
            }
            Err(error) => {
                tracing::error!(program = %config.program.display(), "no worker can be started: {error}")
            }
        }
        early_deaths = if born.elapsed() < config.healthy_after { early_deaths + 1 } else { 0 };
        let doubled = config.backoff_base.saturating_mul(1 << early_deaths.saturating_sub(1).min(16));
        tokio::select! {
            () = sleep(doubled.min(config.backoff_cap)) => {}
            () = shutdown.cancelled() => {}
        }
    }
    started.expire_earlier_workers(&config, &store).await;
}

/// Whether a child that has just ended died alone.
async fn classify_death(config: &SuperviseConfig, shutdown: &CancellationToken) -> WorkerDeath {
    tokio::select! {
        biased;
        () = shutdown.cancelled() => WorkerDeath::WithService,
        () = sleep(config.blame_delay) => WorkerDeath::Alone,
    }
}

fn start(config: &SuperviseConfig, id: &str) -> std::io::Result<Child> {
    Command::new(&config.program)
        .args(&config.arguments)
        .envs(config.environment.iter().map(|(name, value)| (name, value)))
        .env(WORKER_ID_VARIABLE, id)
        .stdin(Stdio::piped())
        // A worker logs to standard error; standard output belongs to the parent alone.
        .stdout(Stdio::null())
        .kill_on_drop(true)
        .spawn()
}

/// Waits for the child's end; on shutdown asks it to stop, and kills it after the grace time.
async fn wait_or_stop(
    config: &SuperviseConfig,
    child: &mut Child,
    shutdown: &CancellationToken,
) -> std::io::Result<ExitStatus> {
    // `wait` would close the child's input, which asks it to stop, unless it is taken out first.
    let stdin = child.stdin.take();
    tokio::select! {
        status = child.wait() => return status,
        () = shutdown.cancelled() => drop(stdin),
    }
    if let Ok(status) = timeout(config.grace, child.wait()).await {
        return status;
    }
    tracing::warn!(pid = child.id(), "a worker did not exit in time; killing it");
    child.kill().await?;
    child.wait().await
}
