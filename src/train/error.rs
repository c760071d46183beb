//! What can stop a training run.

use thiserror::Error;

use super::{CheckpointError, OverBudget, context::ContextError};
use crate::{
    domain::{PhotographError, Problem},
    gpu::GpuError,
    model::InitError,
    render::RenderError,
};

/// Why training ended without a scene.
#[derive(Debug, Error)]
pub enum TrainError {
    /// The dataset has no frame to train on.
    #[error("the dataset has no training image")]
    NoTrainingFrames,
    /// The points cannot begin a scene.
    #[error("the point cloud: {0}")]
    Points(#[from] InitError),
    /// Every anchor or Gaussian was pruned: the photographs and poses do not agree on anything.
    #[error("everything was pruned at step {step}; the poses and the photographs do not describe one scene")]
    NothingLeft {
        /// When.
        step: u32,
    },
    /// The loss is not finite.
    #[error("the loss is not finite at step {step}")]
    Diverged {
        /// When.
        step: u32,
    },
    /// A photograph is gone.
    #[error(transparent)]
    Photograph(#[from] PhotographError),
    /// More memory is needed than there may be.
    #[error(transparent)]
    OverBudget(#[from] OverBudget),
    /// The run cannot go on from the checkpoint that it was given.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The context model cannot be what it was asked to be.
    #[error(transparent)]
    Device(#[from] ContextError),
    /// Somebody asked for a stop.
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
            TrainError::Gpu(fault) => fault.into(),
            TrainError::Render(fault) => fault.into(),
            TrainError::Photograph(fault) => fault.into(),
            TrainError::OverBudget(fault) => fault.into(),
            TrainError::Checkpoint(fault) => fault.into(),
            other => Problem::new(422, "training-failed", "Training failed", other.to_string()),
        }
    }
}
