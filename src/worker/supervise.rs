//! Keeps worker processes alive beside the API.
//!
//! Training runs in a process of its own because what usually ends it (the kernel's out-of-memory killer, a driver's
//! crash) ends a whole process, and that must not be the one that answers requests. A child's standard input is a pipe that
//! the supervisor holds open: closing it asks the child to drain and exit, and because the system closes it
//! when the parent dies, no child outlives its parent.

use std::{
    ffi::OsString,
    path::PathBuf,
    process::{ExitStatus, Stdio},
    sync::Arc,
    time::Duration,
};

use tokio::{
    process::{Child, Command},
    sync::watch,
    task::JoinSet,
    time::{Instant, sleep, timeout},
};
use tokio_util::sync::CancellationToken;

use super::{WORKER_ID_VARIABLE, fresh_id, liveness};
use crate::store::{Store, WorkerDeath};

/// What to run and how patiently.
#[derive(Debug, Clone)]
pub struct SuperviseConfig {
    /// The worker's program.
    pub program: PathBuf,
    /// Its arguments.
    pub arguments: Vec<OsString>,
    /// Variables added to its environment.
    pub environment: Vec<(OsString, OsString)>,
    /// How many to keep alive.
    pub workers: usize,
    /// How long a child may take to drain before it is killed; above [`super::WorkerConfig::drain`].
    pub grace: Duration,
    /// Pause before a child that died young is started again; doubles with each early death.
    pub backoff_base: Duration,
    /// Longest pause.
    pub backoff_cap: Duration,
    /// A child that lived this long did not die young.
    pub healthy_after: Duration,
    /// Pause after a child's end before its job is held to be what ended it: who kills a whole group of processes ends this one
    /// next.
    pub blame_delay: Duration,
    /// Folder in which children show that they are alive ([`super::WorkerConfig::liveness_dir`]), if they do.
    pub liveness_dir: Option<PathBuf>,
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
        }
    }
}

/// Running supervision.
#[derive(Debug)]
pub struct Supervisor {
    children: Vec<watch::Receiver<Option<u32>>>,
    tasks: JoinSet<()>,
}

/// A cheap view of which children live, for readiness answers.
#[derive(Debug, Clone)]
pub struct LiveWorkers(Vec<watch::Receiver<Option<u32>>>);

impl LiveWorkers {
    /// How many children there should be.
    #[must_use]
    pub fn expected(&self) -> usize {
        self.0.len()
    }

    /// Process ids of those that live.
    #[must_use]
    pub fn living(&self) -> Vec<u32> {
        self.0.iter().filter_map(|child| *child.borrow()).collect()
    }
}

/// Starts the workers and keeps them alive until `shutdown`.
#[must_use]
pub fn supervise(config: SuperviseConfig, store: Arc<dyn Store>, shutdown: CancellationToken) -> Supervisor {
    let config = Arc::new(config);
    let mut tasks = JoinSet::new();
    let children = (0..config.workers)
        .map(|_| {
            let (pid, watched) = watch::channel(None);
            tasks.spawn(keep_alive(Arc::clone(&config), Arc::clone(&store), pid, shutdown.clone()));
            watched
        })
        .collect();
    Supervisor { children, tasks }
}

impl Supervisor {
    /// Which children live.
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
    store: Arc<dyn Store>,
    pid: watch::Sender<Option<u32>>,
    shutdown: CancellationToken,
) {
    let mut early_deaths = 0_u32;
    while !shutdown.is_cancelled() {
        if let Some(folder) = &config.liveness_dir {
            liveness::expire_dead_workers(folder, &*store).await;
        }
        let id = fresh_id();
        let born = Instant::now();
        match start(&config, &id) {
            Ok(mut child) => {
                pid.send_replace(child.id());
                let status = wait_or_stop(&config, &mut child, &shutdown).await;
                pid.send_replace(None);
                tracing::info!(worker = id, ?status, "worker {id} has ended");
                // It can write nothing more, so its job need not wait for the lease to run out.
                let death = classify_death(&config, &shutdown).await;
                match store.expire_worker(&id, death).await {
                    Ok(0) => {}
                    Ok(jobs) => {
                        tracing::warn!(worker = id, jobs, "took {jobs} jobs from the dead worker {id}")
                    }
                    Err(error) => {
                        let cause = &error as &dyn std::error::Error;
                        tracing::error!(
                            worker = id,
                            error = cause,
                            "the leases of {id} must run out: {error}"
                        );
                    }
                }
            }
            Err(error) => tracing::error!(program = %config.program.display(), "no worker starts: {error}"),
        }
        early_deaths = if born.elapsed() < config.healthy_after { early_deaths + 1 } else { 0 };
        let doubled = config.backoff_base.saturating_mul(1 << early_deaths.saturating_sub(1).min(16));
        tokio::select! {
            () = sleep(doubled.min(config.backoff_cap)) => {}
            () = shutdown.cancelled() => {}
        }
    }
}

/// How a child that has just ended did so.
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

/// Waits for the child's end, or brings it about on shutdown.
async fn wait_or_stop(
    config: &SuperviseConfig,
    child: &mut Child,
    shutdown: &CancellationToken,
) -> std::io::Result<ExitStatus> {
    // `wait` closes the child's input unless it is taken out first, and that would ask it to stop.
    let stdin = child.stdin.take();
    tokio::select! {
        status = child.wait() => return status,
        () = shutdown.cancelled() => drop(stdin),
    }
    if let Ok(status) = timeout(config.grace, child.wait()).await {
        return status;
    }
    tracing::warn!(pid = child.id(), "a worker did not drain in time; killing it");
    child.kill().await?;
    child.wait().await
}
