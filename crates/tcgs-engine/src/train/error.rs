//! The errors of a training run.

use thiserror::Error;

use super::{CheckpointError, RunTooLarge};
use crate::{
    domain::{PhotographError, Problem, ProblemType},
    gpu::GpuError,
    init::InitError,
    render::RenderError,
};

/// Result of a part of training.
pub(super) type Result<T, E = TrainError> = std::result::Result<T, E>;

/// Steps after which a run has found any scene that its photographs describe.
const ENOUGH_STEPS: u32 = 225;

fn why_nothing_is_left(step: u32) -> &'static str {
    if step < ENOUGH_STEPS {
        "so early, the run may be too short: train for more iterations, and check the poses if that does not help"
    } else {
        "the poses and the photographs do not describe one scene"
    }
}

/// Why training ended without a scene.
#[derive(Debug, Error)]
pub enum TrainError {
    /// The dataset has no training frame.
    #[error("the dataset has no training image")]
    NoTrainingFrames,
    /// The point cloud cannot initialize a scene.
    #[error("the point cloud: {0}")]
    Points(#[from] InitError),
    /// The cameras look at a place so far from the origin that double precision cannot tell its points apart.
    #[error(
        "the cameras look at a place {distance} units from the origin, and only {side} units across: double precision cannot \
         tell its points apart; move the scene closer to the origin"
    )]
    FarFromOrigin {
        /// Of the box of first points, in world units.
        distance: f64,
        /// Of the box.
        side: f64,
    },
    /// Every anchor or Gaussian was pruned: the photographs and poses do not agree on anything, or the run was too short to tell.
    #[error("everything was pruned at step {step}; {}", why_nothing_is_left(*step))]
    NothingLeft {
        /// The step.
        step: u32,
    },
    /// The loss is not finite.
    #[error("the loss is not finite at step {step}")]
    Diverged {
        /// The step.
        step: u32,
    },
    /// A photograph cannot be read back.
    #[error(transparent)]
    Photograph(#[from] PhotographError),
    /// The run does not fit the memory budget or the adapter.
    #[error(transparent)]
    TooLarge(#[from] RunTooLarge),
    /// The run cannot resume from the given checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The context model cannot be made.
    #[error(transparent)]
    Context(#[from] ContextError),
    /// The run was cancelled.
    #[error("cancelled")]
    Cancelled,
    /// The renderer failed.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The device failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

impl From<TrainError> for Problem {
    fn from(error: TrainError) -> Self {
        match error {
            TrainError::Gpu(error) => error.into(),
            TrainError::Render(error) => error.into(),
            TrainError::Photograph(error) => error.into(),
            TrainError::TooLarge(error) => error.into(),
            TrainError::Checkpoint(error) => error.into(),
            other => Problem::new(ProblemType::TrainingFailed, other.to_string()),
        }
    }
}

/// Why a context model cannot be made.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum ContextError {
    /// Sizes that the kernels do not know.
    #[error("the context model's sizes: {0}")]
    Config(String),
    /// A table of anchors that does not match the model.
    #[error("the context model's anchors: {0}")]
    Anchors(String),
    /// An array of parameters of another length.
    #[error("the context model has {expected} parameters, not {found}")]
    Parameters {
        /// Those given.
        found: usize,
        /// Those needed.
        expected: usize,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_are_blamed_only_after_a_run_that_was_long_enough() {
        let told = |step| TrainError::NothingLeft { step }.to_string();
        assert!(
            told(33).contains("step 33; so early") && !told(33).contains("do not describe"),
            "{}",
            told(33)
        );
        assert!(told(300).contains("do not describe one scene"), "{}", told(300));
    }
}
