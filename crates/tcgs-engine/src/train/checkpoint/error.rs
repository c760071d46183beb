//! The errors of checkpoints.

use std::{
    io,
    path::{Path, PathBuf},
};

use thiserror::Error;

use super::{GENERATOR, VERSION};
use crate::domain::{Digest, Problem, ProblemType};

/// Why a checkpoint cannot be saved or resumed from.
#[derive(Debug, Error)]
pub enum CheckpointError {
    /// There is no checkpoint.
    #[error("{} does not exist; there is no checkpoint to resume from", .0.display())]
    Missing(PathBuf),
    /// A file system error.
    #[error("{}: {error}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        error: io::Error,
    },
    /// The file is truncated or not a checkpoint.
    #[error("not a complete checkpoint: {0}")]
    Format(String),
    /// The checksum does not match.
    #[error("the checkpoint is damaged: its checksum is {found:08x}, the file states {stated}")]
    Damaged {
        /// The checksum of the content.
        found: u32,
        /// The checksum in the file.
        stated: String,
    },
    /// The file has another format version.
    #[error("the checkpoint has format version {0}; this program reads version {VERSION}")]
    Version(String),
    /// Another version of the program wrote it.
    #[error(
        "the checkpoint was written by {0}, this is {GENERATOR}; a run must finish with the version that started it"
    )]
    Generator(String),
    /// The checkpoint's run has other options.
    #[error("the checkpoint belongs to a run with other options: {0}")]
    Options(String),
    /// The checkpoint's run trains on another dataset.
    #[error("the checkpoint belongs to a run on dataset {found}, this is dataset {expected}")]
    Dataset {
        /// The checkpoint's.
        found: Digest,
        /// The run's.
        expected: Digest,
    },
    /// An array does not match the model.
    #[error("the checkpoint's array '{name}' {error}")]
    Array {
        /// Its name.
        name: String,
        /// The error.
        error: String,
    },
    /// A value of the run is invalid.
    #[error("the checkpoint's {0}")]
    Run(String),
}

impl CheckpointError {
    /// An error in the array `name`.
    pub(in crate::train) fn array(name: &str, error: impl Into<String>) -> Self {
        Self::Array { name: name.to_owned(), error: error.into() }
    }

    /// A file system error at `path`.
    pub(super) fn io(path: &Path, error: io::Error) -> Self {
        Self::Io { path: path.to_owned(), error }
    }
}

impl From<CheckpointError> for Problem {
    fn from(error: CheckpointError) -> Self {
        Problem::new(ProblemType::CheckpointRefused, error.to_string())
    }
}
