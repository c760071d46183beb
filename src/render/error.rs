//! What can go wrong when rendering.

use thiserror::Error;

use crate::{
    domain::{PhotographError, Problem},
    gpu::GpuError,
};

/// A fault of rendering.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum RenderError {
    /// A fault of the device.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A backward pass was asked for that does not follow a forward pass of the same camera and Gaussians.
    #[error("the backward pass needs the forward pass of the same camera and capacity just before it")]
    OutOfStep,
    /// What a view is compared with is gone.
    #[error(transparent)]
    Photograph(#[from] PhotographError),
    /// A scene that this renderer cannot show.
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
            RenderError::Gpu(fault) => fault.into(),
            RenderError::Photograph(fault) => fault.into(),
            fault => Problem::new(500, "render", "The view could not be rendered", fault.to_string()),
        }
    }
}
