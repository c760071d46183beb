//! Errors of LPIPS: unusable weights, or images that cannot be compared.

use safetensors::{Dtype, SafeTensorError};
use thiserror::Error;

use tcgs_codec::domain::{LpipsNetwork, Problem, ProblemType};

/// Why there is no LPIPS figure.
#[derive(Debug, Error)]
pub enum LpipsError {
    /// The file of weights is not safetensors.
    #[error("not a safetensors file: {0}")]
    NotSafetensors(#[from] SafeTensorError),
    /// A tensor is not in the file.
    #[error("there is no tensor {wanted}")]
    Missing {
        /// The names that were looked for.
        wanted: String,
    },
    /// The first convolution's shape matches neither network.
    #[error(
        "{tensor} has shape {found:?}, which is neither AlexNet's [64, 3, 11, 11] nor VGG16's [64, 3, 3, 3]"
    )]
    UnknownNetwork {
        /// The tensor.
        tensor: String,
        /// Its shape.
        found: Vec<usize>,
    },
    /// A tensor has another shape than its network's.
    #[error("{tensor} has shape {found:?} instead of {expected:?} in {network}")]
    Shape {
        /// The tensor.
        tensor: String,
        /// The network, as told by the first convolution.
        network: LpipsNetwork,
        /// The expected shape.
        expected: Vec<usize>,
        /// The shape in the file.
        found: Vec<usize>,
    },
    /// A tensor is not f32.
    #[error("{tensor} holds {found:?} instead of F32 values; convert it with .float()")]
    Type {
        /// The tensor.
        tensor: String,
        /// Its element type.
        found: Dtype,
    },
    /// A tensor has an infinite or NaN value, or a zero divisor.
    #[error("{tensor} has a value that cannot be computed with")]
    Value {
        /// The tensor.
        tensor: String,
    },
    /// The images are not RGB, or differ in size.
    #[error("two RGB images of one size are needed")]
    NotComparable,
    /// The images are smaller than the network's pooling allows.
    #[error("an image of {width}x{height} pixels is too small for {network}, which needs {min} a side")]
    TooSmall {
        /// The network.
        network: LpipsNetwork,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// The smallest width and height.
        min: u32,
    },
    /// Features or their differences overflow f32.
    #[error("the weights lead to values beyond the range of f32")]
    Overflow,
}

impl From<LpipsError> for Problem {
    fn from(error: LpipsError) -> Self {
        let kind = match &error {
            LpipsError::NotComparable | LpipsError::TooSmall { .. } => ProblemType::LpipsImages,
            _ => ProblemType::LpipsWeights,
        };
        Problem::new(kind, error.to_string())
    }
}
