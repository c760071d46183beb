//! What learns: the part of a training run that differs from model to model.
//!
//! The step loop owns photographs, rasteriser and losses; a learner turns its parameters into the Gaussians of a view and
//! the loss's gradients by those into its next parameters. What always holds: a learner's state after a step is a
//! function of its state before, the camera, the step and the random generator that it is handed; and a learner that is
//! made from what [`Learner::save`] gave goes on with the same bits.

use rand_pcg::Pcg64;

use super::{TrainError, TrainedContext, checkpoint::LearnerState};
use crate::{
    domain::{Camera, CancelFlag, Frame, Scene},
    gpu::{Buffer, Recorder},
    render::{GaussianGradients, Gaussians},
};

/// A step's place in the run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Step {
    /// From 1.
    pub number: u32,
    /// Its number over the steps of the run, in (0, 1].
    pub fraction: f64,
    /// Weight of the rate in the loss.
    pub lambda: f64,
}

/// How large a model is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Size {
    /// Anchors; zero in a model that has none.
    pub anchors: usize,
    /// Gaussians that the last view was made of.
    pub gaussians: usize,
}

/// What the anchors of the last sample cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SampleRate {
    /// Bits of an anchor's attributes, on average.
    pub bits_an_anchor: f64,
    /// Bytes of all else in a file, about.
    pub other_bytes: f64,
}

/// What is left of a learner.
#[derive(Debug, Clone)]
pub(super) struct Finished {
    pub scene: Scene,
    /// None where the model has none.
    pub context: Option<TrainedContext>,
}

/// A model in training. See the module's words.
pub(super) trait Learner {
    /// Records the Gaussians that `camera` sees.
    fn forward(
        &mut self,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        step: &Step,
    ) -> Result<(), TrainError>;

    /// What the last [`Learner::forward`] recorded.
    fn gaussians(&self) -> &Gaussians;

    /// Where the rasteriser is to write the loss's gradients by them.
    fn gaussian_gradients(&mut self) -> Result<GaussianGradients, TrainError>;

    /// Records the gradients by the parameters, the statistics that growth goes by, and the optimiser's step. If `overflow_flag` is
    /// set by the time that these are run, the step will be done again: then nothing of it may last.
    fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        step: &Step,
        overflow_flag: &Buffer<u32>,
    ) -> Result<(), TrainError>;

    /// Whether the schedule wants [`Learner::adapt`] after a step.
    fn adapts(&self, step: &Step) -> bool;

    /// Grows, prunes and resets after a submitted step; `frames` are the photographs that it learns from. May wait for the
    /// device; ends as [`TrainError::Cancelled`] where it would take long.
    fn adapt(
        &mut self,
        step: &Step,
        rng: &mut Pcg64,
        frames: &[&Frame],
        cancel: &CancelFlag,
    ) -> Result<(), TrainError>;

    /// Anchors; zero in a model that has none.
    fn anchors(&self) -> usize;

    /// How large the model is. May wait for the device.
    fn size(&self) -> Result<Size, TrainError>;

    /// What the last submitted step's sample costs; none where its loss has no rate. May wait for the device.
    fn rate(&self) -> Result<Option<SampleRate>, TrainError>;

    /// Everything that the next step depends on. Waits for the device.
    fn save(&self) -> Result<LearnerState, TrainError>;

    /// The finished scene; `frames` are the photographs that it learnt from.
    fn finish(self: Box<Self>, frames: &[&Frame], cancel: &CancelFlag) -> Result<Finished, TrainError>;
}
