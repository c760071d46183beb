//! The progress of a job, and the flag that cancels it.

use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use serde::{Deserialize, Serialize};

use super::{choice::named_choice, image::Image};

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

/// A picture of the model in training and the photograph of the same view, both RGB; clones share them.
#[derive(Clone)]
pub struct Preview {
    /// The model's view.
    pub render: Arc<Image>,
    /// The same in all previews of a run.
    pub photograph: Arc<Image>,
}

/// Whether it is the same picture, not an equal one.
impl PartialEq for Preview {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.render, &other.render)
    }
}

impl fmt::Debug for Preview {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Preview({}x{})", self.render.width(), self.render.height())
    }
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
    /// PSNR of the model in dB: of a few held-out views, measured now and then, or of training views over recent steps.
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
    /// A new picture of the model.
    #[serde(skip)]
    pub preview: Option<Preview>,
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
