//! Takes jobs from the queue and carries them out, in a process of its own.
//!
//! What a run needs to be continued is kept beside it until its job has succeeded, so an attempt goes on where the one before
//! it stopped, and so does a job that repeats one that failed or was cancelled not long ago.
//!
//! A worker runs one job at a time on a thread of its own while an asynchronous task keeps the lease, passes
//! progress on and listens for a stop. It never writes to a job that it no longer holds. The parent process
//! keeps workers alive through [`supervise`]: a worker that is killed, or that ends itself because a job
//! hangs, is started again, and its job is taken from it at once. One that died with its parent is found dead by the next
//! parent (`liveness`).

mod attempt;
mod checkpoints;
mod claim;
mod liveness;
mod series_buffer;
mod storage;
pub mod supervise;

use std::{path::PathBuf, time::Duration};

use thiserror::Error;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

pub use checkpoints::forget as forget_checkpoints;
pub use claim::serve;

use crate::domain::JobId;

/// The environment variable in which a supervisor tells a worker its identity.
pub const WORKER_ID_VARIABLE: &str = "TCGS_WORKER_ID";

/// How a worker behaves.
#[derive(Debug, Clone)]
pub struct WorkerConfig {
    /// Its identity in leases; no two live workers may share one.
    pub id: String,
    /// How often an idle worker looks for a job.
    pub poll: Duration,
    /// How often the lease is renewed; well below [`WorkerConfig::lease`].
    pub heartbeat: Duration,
    /// How long the queue's leases last ([`crate::store::QueuePolicy::lease`]): after that long without a
    /// successful renewal the job is held to be lost.
    pub lease: Duration,
    /// Shortest time between two progress reports to the store.
    pub report_every: Duration,
    /// Longest silence of a run before it is held to hang. The run cannot be killed from within, so the worker
    /// gives the job back as a failed attempt and ends with [`WorkerError::Stalled`]; its process must exit.
    pub stall_limit: Duration,
    /// How long a run may take to stop when the worker shuts down, before its job is released regardless.
    pub drain: Duration,
    /// Folder for a folder of checkpoints a running job, if they are to be kept: a later attempt goes on from there.
    pub checkpoints: Option<PathBuf>,
    /// Folder in which a supervised worker shows that it is alive ([`supervise::SuperviseConfig::liveness_dir`]).
    pub liveness_dir: Option<PathBuf>,
}

impl WorkerConfig {
    /// The defaults, under the identity that the supervisor gave, or a fresh one.
    #[must_use]
    pub fn from_environment() -> Self {
        Self::new(std::env::var(WORKER_ID_VARIABLE).unwrap_or_else(|_| fresh_id()))
    }

    /// The defaults under a given identity.
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
            liveness_dir: None,
        }
    }
}

/// Why a worker cannot go on.
#[derive(Debug, Error)]
pub enum WorkerError {
    /// A run made no progress and did not stop; only ending the process frees what it holds.
    #[error("attempt {attempt} at job {job} hangs: no progress for {} s", limit.as_secs())]
    Stalled {
        /// The job.
        job: JobId,
        /// The attempt.
        attempt: u32,
        /// [`WorkerConfig::stall_limit`].
        limit: Duration,
    },
}

/// An identity that no other worker has.
#[must_use]
pub fn fresh_id() -> String {
    format!("worker-{}-{}", std::process::id(), Uuid::now_v7().simple())
}

/// Cancels `stop` once standard input is at its end, which is how a supervised worker learns that its parent
/// has asked it to stop or is gone.
///
/// # Errors
/// If no thread can be started.
pub fn stop_when_stdin_closes(stop: CancellationToken) -> std::io::Result<()> {
    // A plain thread: a read that tokio's pool is waiting for would keep the process from ending.
    std::thread::Builder::new().name("stdin".into()).spawn(move || {
        let _ = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
        stop.cancel();
    })?;
    Ok(())
}
