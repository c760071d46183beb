//! What all files of one job are made from.

use std::sync::Arc;

use jiff::SignedDuration;

use super::error::JobError;
use crate::{
    domain::{CancelFlag, Dataset, Frame, MemoryBudget, Split, TrainOptions, evenly_spaced::evenly_spaced},
    eval::{ColorFit, PerceptualDistance, TrainView},
    gpu::Device,
    train::Trainer,
};

/// Views that the renderer is held to the reference on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReferenceViews {
    /// Held-out views, at most.
    pub views: usize,
    /// Longest side in pixels that they are rendered at: the reference takes a core seconds to minutes.
    pub max_side: u32,
}

/// What all files of one job share: several, if it makes a rate-distortion curve.
pub(super) struct RunInputs<'a> {
    pub(super) device: Arc<Device>,
    pub(super) dataset: &'a Dataset,
    pub(super) budget: MemoryBudget,
    pub(super) cancel: &'a CancelFlag,
    /// LPIPS, if it is measured.
    pub(super) lpips: Option<&'a dyn PerceptualDistance>,
    /// Views that the renderer is held to the f64 reference on, if it is.
    pub(super) reference: Option<ReferenceViews>,
    /// Time between two checkpoints, if it is not the usual one.
    pub(super) checkpoint_every: Option<SignedDuration>,
    /// Whether reports have pictures of the model and figures measured on it.
    pub(super) is_watched: bool,
    /// Seconds that the dataset took to read.
    pub(super) ingest_seconds: f64,
}

impl<'a> RunInputs<'a> {
    /// A run of this job.
    pub(super) fn trainer<'b, 'c>(&'b self, options: &'b TrainOptions) -> Trainer<'b, 'c> {
        Trainer::new(&self.device, self.dataset, options)
            .within(self.budget)
            .cancelled_by(self.cancel)
            .watched(self.is_watched)
    }

    pub(super) fn test_views(&self) -> Vec<&'a Frame> {
        self.dataset.split(Split::Test).collect()
    }

    /// At most `max` of the training views, evenly spread.
    pub(super) fn train_views(&self, max: usize) -> Vec<&'a Frame> {
        let frames: Vec<&Frame> = self.dataset.split(Split::Train).collect();
        evenly_spaced(&frames, max).copied().collect()
    }

    /// At most `max` of the training views, evenly spread, with the color corrections that a run learnt, if it did.
    pub(super) fn corrected_views(&self, max: usize, corrections: Option<&[ColorFit]>) -> Vec<TrainView<'a>> {
        let correction = |index: usize| corrections.and_then(|all| all.get(index).copied());
        let frames = self.dataset.split(Split::Train).enumerate();
        let views: Vec<TrainView<'a>> =
            frames.map(|(index, frame)| TrainView { frame, correction: correction(index) }).collect();
        evenly_spaced(&views, max).copied().collect()
    }

    /// Mean pixels of a training photograph.
    pub(super) fn view_pixels(&self) -> Option<u64> {
        let (mut views, mut pixels) = (0, 0);
        for frame in self.dataset.split(Split::Train) {
            views += 1;
            pixels += u64::from(frame.image.width()) * u64::from(frame.image.height());
        }
        pixels.checked_div(views)
    }

    /// Fails once the job is cancelled.
    pub(super) fn check_cancelled(&self) -> Result<(), JobError> {
        if self.cancel.is_cancelled() { Err(JobError::Cancelled) } else { Ok(()) }
    }
}
