//! The progress of a job, and the flag that cancels it.

use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};

use serde::{Deserialize, Serialize};

use super::choice::named_choice;

named_choice! {
    /// A stage of a job.
    pub enum Phase {
        /// Waiting for a worker.
        Queued = "queued",
        /// Reading and checking the dataset.
        Ingest = "ingest",
        /// Finding the cameras of photographs that have none.
        Poses = "poses",
        /// Training.
        Train = "train",
        /// Writing the file.
        Encode = "encode",
        /// Decoding the file and measuring it on the held-out views.
        Evaluate = "evaluate",
        /// Storing the artifact.
        Publish = "publish",
        /// Nothing left to do.
        Done = "done",
    }
}

named_choice! {
    /// A part of the search for cameras.
    pub enum PoseStage {
        /// Frames are taken from a video.
        Frames = "frames",
        /// Distinct points of each photograph are found.
        Features = "features",
        /// Pairs of photographs are compared.
        Matches = "matches",
        /// Photographs are registered, one after the other.
        Mapping = "mapping",
    }
}

/// Progress of the search for cameras.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PoseProgress {
    /// The part of the search.
    pub stage: PoseStage,
    /// Frames, photographs, pairs or registered photographs that are done; pairs of sequential matching are an estimate.
    pub done: u64,
    /// Of how many.
    pub total: u64,
    /// Mean distance of points from where photographs show them, in pixels, once the cameras are found.
    #[serde(default)]
    pub reprojection_error: Option<f64>,
}

/// A report of progress, as the API and the progress bar show it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Progress {
    /// Iterations done.
    pub step: u64,
    /// Iterations in all.
    pub total: u64,
    /// Seconds since the attempt began.
    pub elapsed_seconds: f64,
    /// Estimated seconds left, once known.
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
    /// Training SSIM, averaged over recent steps.
    pub ssim: Option<f64>,
    /// Estimated bytes of the file, once training measures them.
    pub bytes: Option<u64>,
    /// The search for cameras, in the phase `poses`.
    pub poses: Option<PoseProgress>,
    /// Iteration of the newest checkpoint, 0 before the first. Only the queue uses it, to see whether an attempt made progress.
    #[serde(skip)]
    pub checkpoint_step: u64,
}

/// A flag that is set once to cancel work in another thread.
#[derive(Debug, Clone, Default)]
pub struct CancelFlag(Arc<AtomicBool>);

impl CancelFlag {
    /// Requests cancellation.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether cancellation was requested.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}
