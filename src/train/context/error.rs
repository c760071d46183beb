//! What a context model cannot be made of.

use thiserror::Error;

/// A fault in what a context model is asked to be.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum ContextError {
    /// Sizes that the kernels do not know.
    #[error("the context model's sizes: {0}")]
    Config(String),
    /// A table of anchors that does not fit the model.
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
