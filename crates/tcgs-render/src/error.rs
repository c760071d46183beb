//! Errors of rendering.

use thiserror::Error;

use crate::{
    domain::{PhotographError, Problem, ProblemType},
    gpu::GpuError,
};

/// Result of a part of the renderer.
pub(super) type Result<T, E = RenderError> = std::result::Result<T, E>;

/// An error of rendering.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum RenderError {
    /// An error of the device.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A backward pass without a preceding forward pass of the same camera and Gaussians.
    #[error("the backward pass needs the forward pass of the same camera and capacity just before it")]
    OutOfStep,
    /// The photograph of a view cannot be read.
    #[error(transparent)]
    Photograph(#[from] PhotographError),
    /// A scene that this renderer does not support.
    #[error("the scene cannot be rendered: {0}")]
    Scene(String),
    /// A column is shorter than the capacity, or an image's length is not its width times its height.
    #[error("{what} has {found} elements instead of {expected}")]
    Length {
        /// Which buffer.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length it must have.
        expected: usize,
    },
}

impl From<RenderError> for Problem {
    fn from(error: RenderError) -> Self {
        match error {
            RenderError::Gpu(error) => error.into(),
            RenderError::Photograph(error) => error.into(),
            error => Problem::new(ProblemType::Render, error.to_string()),
        }
    }
}
