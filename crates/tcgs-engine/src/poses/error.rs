//! Why no cameras were found.

use std::{io, path::PathBuf, time::Duration};

use thiserror::Error;

use super::PYCOLMAP_VERSION;
use crate::{
    domain::{Problem, ProblemType, is_no_space},
    ingest::IngestError,
};

/// Why no cameras were found.
#[derive(Debug, Error)]
pub enum PosesError {
    /// The photographs cannot be read, or are too few.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The interpreter is missing, or has no pycolmap.
    #[error(
        "cameras of photographs are found by pycolmap, which '{python}' does not have ({detail}); install it with `make poses`, or with \
         `python3 -m venv ENV && ENV/bin/pip install pycolmap=={PYCOLMAP_VERSION}` and the variable \
         TCGS_POSES_PYTHON=ENV/bin/python3. A colmap of version 3.13 or newer, on the path or named in TCGS_COLMAP, serves too"
    )]
    Unavailable {
        /// The interpreter.
        python: PathBuf,
        /// What it said.
        detail: String,
    },
    /// There is no ffmpeg.
    #[error(
        "photographs of a video are taken by ffmpeg, which cannot be run as '{ffmpeg}' ({detail}); install it (Debian: apt-get install \
         ffmpeg), or name it in TCGS_FFMPEG"
    )]
    VideoUnavailable {
        /// The program.
        ffmpeg: PathBuf,
        /// What it said.
        detail: String,
    },
    /// ffmpeg cannot read the video.
    #[error("the video cannot be read: {0}")]
    VideoUnreadable(String),
    /// A file is no photograph that pycolmap reads.
    #[error("{0}")]
    Unreadable(String),
    /// Too little to recognize.
    #[error(
        "{0}; they are blurred, dark or of bare surfaces. Take sharper ones, and put patterned things into the scene"
    )]
    Featureless(String),
    /// Nothing to begin with.
    #[error(
        "{0}; each place should be on three photographs, from places a step apart, and lie still between them"
    )]
    NoOverlap(String),
    /// Most cameras were not found.
    #[error(
        "the cameras of {registered} of {photographs} photographs were found, and of half at least are needed; photographs between those \
         that were found and the others would connect them. Without a camera, for example: {examples}"
    )]
    TooFewRegistered {
        /// Cameras that were found.
        registered: usize,
        /// Photographs that were given.
        photographs: usize,
        /// Some names of the others.
        examples: String,
    },
    /// The time is over.
    #[error("cameras were not found within {} s; allow more time, use fewer photographs, or --matching sequential for frames of a video", .0.as_secs())]
    TimedOut(Duration),
    /// The child ended without an answer.
    #[error("the search for cameras ended early ({status}): {detail}")]
    Died {
        /// How it ended.
        status: String,
        /// The end of what it wrote.
        detail: String,
    },
    /// ffmpeg was ended by a signal.
    #[error("ffmpeg ended early while it took photographs of the video ({status}): {detail}")]
    FramesDied {
        /// How it ended.
        status: String,
        /// The end of what it wrote.
        detail: String,
    },
    /// A file or a process failed.
    #[error("{what}: {error}")]
    Io {
        /// What was tried.
        what: &'static str,
        /// The cause.
        #[source]
        error: io::Error,
    },
    /// The caller asked to stop.
    #[error("stopped")]
    Cancelled,
}

impl From<PosesError> for Problem {
    fn from(error: PosesError) -> Self {
        let detail = error.to_string();
        let kind = match error {
            PosesError::Ingest(error) => return error.into(),
            PosesError::Unavailable { .. } => ProblemType::PosesUnavailable,
            PosesError::VideoUnavailable { .. } => ProblemType::VideoUnavailable,
            PosesError::VideoUnreadable(_) => ProblemType::VideoRejected,
            PosesError::Unreadable(_) => ProblemType::ImageRejected,
            PosesError::Featureless(_) => ProblemType::FeaturelessPhotographs,
            PosesError::NoOverlap(_) => ProblemType::NoOverlap,
            PosesError::TooFewRegistered { .. } => ProblemType::TooFewRegistered,
            PosesError::TimedOut(_) => ProblemType::PosesTimedOut,
            PosesError::Died { .. } | PosesError::FramesDied { .. } => ProblemType::PosesFailed,
            PosesError::Io { ref error, .. } if is_no_space(error) => ProblemType::StorageFull,
            PosesError::Io { .. } => ProblemType::StorageFailed,
            PosesError::Cancelled => ProblemType::Stopped,
        };
        Problem::new(kind, detail)
    }
}
