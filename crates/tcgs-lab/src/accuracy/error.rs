//! Why a case could not be measured.

use tcgs_codec::domain::Problem;
use tcgs_render::{RenderError, gpu::GpuError};

/// A fault of the device or of a setup while a case was measured; a bound that is not held is no error.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{case}: {error}")]
pub struct AccuracyError {
    /// Name of the case.
    pub case: &'static str,
    /// What happened.
    #[source]
    pub error: CaseError,
}

/// What may go wrong within a case.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CaseError {
    /// A fault of the device.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A fault of the renderer.
    #[error(transparent)]
    Render(#[from] RenderError),
}

impl From<AccuracyError> for Problem {
    fn from(error: AccuracyError) -> Self {
        let mut problem = match error.error {
            CaseError::Gpu(error) => Problem::from(error),
            CaseError::Render(error) => Problem::from(error),
        };
        problem.detail = format!("{}: {}", error.case, problem.detail);
        problem
    }
}
