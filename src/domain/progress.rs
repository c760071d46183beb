//! How far a job is, and the flag that stops it.

use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};

use serde::{Deserialize, Serialize};

/// A stage of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// Waiting for a worker.
    Queued,
    /// Reading and checking the dataset.
    Ingest,
    /// Training.
    Train,
    /// Writing the file.
    Encode,
    /// Decoding the file and measuring it on the held-out views.
    Evaluate,
    /// Storing the artifact.
    Publish,
    /// Nothing left to do.
    Done,
}

/// A report of progress, as the API and the progress bar show it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Progress {
    /// Steps done.
    pub step: u64,
    /// Steps in all.
    pub total: u64,
    /// Seconds since the attempt began.
    pub elapsed_seconds: f64,
    /// Estimated seconds left, once there is a basis for it.
    pub eta_seconds: Option<f64>,
    /// Recent training speed.
    pub steps_per_second: Option<f64>,
    /// Anchors now.
    pub anchors: u64,
    /// Gaussians of the latest rendered view.
    pub gaussians: u64,
    /// Training loss, averaged over recent steps.
    pub loss: Option<f64>,
    /// Training PSNR in dB, averaged over recent steps.
    pub psnr: Option<f64>,
    /// Bytes that the file would about have, once training measures them.
    pub bytes: Option<u64>,
    /// Step of the newest checkpoint, 0 before the first. For the queue alone: it shows whether an attempt got any further.
    #[serde(skip)]
    pub checkpoint_step: u64,
}

/// Set once by whoever wants the work to stop; read by whoever does it.
#[derive(Debug, Clone, Default)]
pub struct CancelFlag(Arc<AtomicBool>);

impl CancelFlag {
    /// Asks for a stop.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether a stop was asked for.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}
