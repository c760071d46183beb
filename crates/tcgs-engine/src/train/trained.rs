//! What a training run leaves.

use super::BaseQuantSteps;
use crate::{
    domain::{Choices, ContextCandidates, ExposureChoice, Scene},
    eval::ColorFit,
};

/// A finished training run.
#[derive(Debug, Clone)]
pub struct Trained {
    /// The scene as the encoder gets it. After compression-aware training its attributes are rounded already; the encoder finds the same
    /// integers again. Networks are floats.
    pub scene: Scene,
    /// The same scene with its attributes before they were rounded; `None` if `scene` was not rounded.
    pub unrounded: Option<Scene>,
    /// Input of the encoder from compression-aware training; none for the baselines.
    pub context: Option<TrainedContext>,
    /// Steps done.
    pub steps: u32,
    /// Seconds of training.
    pub seconds: f64,
    /// What the run chose for its dataset and machine.
    pub choices: Choices,
    /// Whether it learnt color corrections, and why.
    pub exposure: ExposureChoice,
    /// The color correction of each training photograph, in the dataset's order, of a run that learnt them. Files do not have them; the
    /// encoder measures training views with them.
    pub corrections: Option<Vec<ColorFit>>,
}

/// What compression-aware training leaves for the encoder.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainedContext {
    /// The base quantization steps that the scene was trained with.
    pub base_quant_steps: BaseQuantSteps,
    /// The context models that the encoder may select.
    pub candidates: ContextCandidates,
}
