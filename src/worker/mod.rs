//! Takes jobs from the queue and runs them, in a process of its own.
//!
//! Checkpoints of a run are kept until its job has succeeded, so an attempt resumes where the one before stopped, and so does a retry
//! of a job that failed or was cancelled recently.
//!
//! A worker runs one job at a time on a thread of its own, while an asynchronous task renews the lease, reports progress and listens for
//! cancellation and shutdown. It never writes to a job whose lease it has lost. The parent process restarts workers through
//! [`supervise`]: if one is killed, or exits because a job hangs, its job is queued again at once. The next parent detects workers that
//! died with the one before (`liveness`).

mod attempt;
mod capabilities;
mod checkpoint_copies;
mod checkpoints;
mod claim;
mod deps;
mod lease_keeper;
mod liveness;
mod outcomes;
mod preparation;
mod previews;
mod publication;
mod series_buffer;
mod storage;
pub mod supervise;

use std::{path::PathBuf, time::Duration};

use thiserror::Error;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

pub use claim::serve;
pub use preparation::CameraSearch;

use crate::domain::JobId;

/// The environment variable in which a supervisor passes a worker its identity.
pub const WORKER_ID_VARIABLE: &str = "TCGS_WORKER_ID";

/// A worker's settings.
#[derive(Debug, Clone)]
pub struct WorkerConfig {
    /// Its identity in leases, unique among live workers.
    pub id: String,
    /// Polling interval of an idle worker.
    pub poll: Duration,
    /// How often the lease is renewed; well below [`WorkerConfig::lease`].
    pub heartbeat: Duration,
    /// How long the queue's leases last ([`crate::store::QueuePolicy::lease`]): after that long without a successful renewal the worker
    /// assumes that it has lost the job.
    pub lease: Duration,
    /// Interval of progress reports to the store.
    pub report_every: Duration,
    /// Longest time without progress before a run counts as stalled. A thread cannot be killed, so the worker ends the attempt as
    /// failed and returns [`WorkerError::Stalled`]; its process must exit.
    pub stall_limit: Duration,
    /// How long a run may take to stop when the worker shuts down, before its job is released in any case.
    pub drain: Duration,
    /// Folder of the checkpoints of all jobs, if they are kept.
    pub checkpoints: Option<PathBuf>,
    /// Time between two copies of changed checkpoints to the bucket, if there is one.
    pub copy_checkpoints_every: Duration,
    /// Age of a publication after which a result is published again if the end of its job cannot be recorded; well below the grace time
    /// of garbage collection ([`crate::store::garbage::GarbagePolicy::blob_grace`]).
    pub republish_every: Duration,
    /// Folder of the lock files of live workers ([`supervise::SuperviseConfig::liveness_dir`]).
    pub liveness_dir: Option<PathBuf>,
    /// How cameras of photographs are found; without it, jobs that need that are left to other workers.
    pub cameras: Option<CameraSearch>,
    /// How often the worker is announced; well below [`crate::store::WORKER_LIFE`].
    pub announce_every: Duration,
}

impl WorkerConfig {
    /// The defaults, with the identity from the supervisor, or a new one.
    #[must_use]
    pub fn from_environment() -> Self {
        Self::new(std::env::var(WORKER_ID_VARIABLE).unwrap_or_else(|_| new_worker_id()))
    }

    /// The defaults with a given identity.
    #[must_use]
    pub fn new(id: impl Into<String>) -> Self {
        Self {
            id: id.into(),
            poll: Duration::from_millis(500),
            heartbeat: Duration::from_secs(5),
            lease: Duration::from_secs(60),
            report_every: Duration::from_secs(1),
            stall_limit: Duration::from_secs(600),
            drain: Duration::from_secs(20),
            checkpoints: None,
            copy_checkpoints_every: Duration::from_secs(10),
            republish_every: Duration::from_secs(300),
            liveness_dir: None,
            cameras: None,
            announce_every: Duration::from_secs(20),
        }
    }
}

/// Why a worker has to exit.
#[derive(Debug, Error)]
pub enum WorkerError {
    /// A run makes no progress; only the end of the process stops it.
    #[error("attempt {attempt} of job {job} has stalled: no progress for {} s", limit.as_secs())]
    Stalled {
        job: JobId,
        attempt: u32,
        /// [`WorkerConfig::stall_limit`].
        limit: Duration,
    },
}

/// A unique identity.
#[must_use]
pub fn new_worker_id() -> String {
    format!("worker-{}-{}", std::process::id(), Uuid::now_v7().simple())
}

/// Cancels `stop` at the end of standard input: a supervisor closes it to stop its worker, and so does the system when the supervisor
/// dies.
///
/// # Errors
/// If no thread can be started.
pub fn stop_when_stdin_closes(stop: CancellationToken) -> std::io::Result<()> {
    // A plain thread: a blocking read in tokio's pool would prevent the process from exiting.
    std::thread::Builder::new().name("stdin".into()).spawn(move || {
        let _ = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
        stop.cancel();
    })?;
    Ok(())
}
