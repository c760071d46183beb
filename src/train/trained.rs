//! What a training run leaves.

use super::BaseQuantSteps;
use crate::domain::{ContextCandidates, Scene};

/// A finished training run.
#[derive(Debug, Clone)]
pub struct Trained {
    /// The scene, not yet quantised.
    pub scene: Scene,
    /// Input of the encoder from compression-aware training; none for the baselines.
    pub context: Option<TrainedContext>,
    /// Steps done.
    pub steps: u32,
    /// Seconds of training.
    pub seconds: f64,
}

/// What compression-aware training leaves for the encoder.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainedContext {
    /// The base quantisation steps that the scene was trained with.
    pub base_quant_steps: BaseQuantSteps,
    /// The context models that the encoder may select.
    pub candidates: ContextCandidates,
}
