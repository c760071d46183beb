//! Cameras of photographs that have none: COLMAP's structure from motion, by pycolmap in a child process. Photographs of a video come
//! from ffmpeg in another.
//!
//! Invariants: the child gets no network where the system permits that, keeps to a limit of memory, time and threads, and ends with
//! its parent; everything that it writes is below one folder of the caller's; the same photographs, options and seed on the same machine
//! give the same cameras, as far as pycolmap promises that.

mod child;
mod dataset;
mod error;
mod frames;
mod keep_alive;
mod natural_order;
mod options;
mod room;
mod running;

pub use child::{PoseEstimator, find_colmap, find_python};
pub use dataset::{Given, PosedDataset, SEARCH_FOLDER};
pub use error::PosesError;
pub use frames::{ffmpeg_version, find_ffmpeg};
pub use keep_alive::while_reporting;
pub use natural_order::natural_order;
pub use options::{DEFAULT_FRAMES, PoseLimits, PoseOptions};

pub use crate::domain::{CameraModel, Matching, PoseProgress, PoseStage};

#[cfg(all(test, unix))]
mod tests;

use std::{fmt, path::PathBuf};

use serde::{Deserialize, Serialize};
use tcgs_codec::named_choice;

/// The version of pycolmap that is tried and pinned.
pub const PYCOLMAP_VERSION: &str = "4.2.1";

named_choice! {
    /// What keeps the child off the network.
    pub enum NetworkIsolation {
        /// A network namespace of its own, without interfaces.
        Namespace = "namespace",
        /// A filter of system calls (seccomp) that refuses sockets.
        Filter = "filter",
        /// Nothing: the system permits neither.
        None = "none",
    }
}

named_choice! {
    /// What finds cameras.
    #[derive(Default)]
    pub enum PoseEngine {
        /// COLMAP as a package of Python.
        #[default]
        Pycolmap = "pycolmap",
        /// COLMAP's own program, where Python lacks that.
        Colmap = "colmap",
    }
}

/// The program that finds cameras.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PoseProgram {
    /// Which it is.
    #[serde(default)]
    pub engine: PoseEngine,
    /// Its version.
    pub version: String,
    /// What keeps it off the network.
    pub network: NetworkIsolation,
}

impl fmt::Display for PoseProgram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.engine, self.version)
    }
}

/// What was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PoseReport {
    /// Photographs that were given.
    pub photographs: usize,
    /// Names of those whose cameras were found, sorted.
    pub registered: Vec<String>,
    /// Names of the others, in the order given.
    pub unregistered: Vec<String>,
    /// Separate models that the photographs fell apart into; the largest is taken.
    pub models: usize,
    /// Points of the model.
    pub points: u64,
    /// Cameras of the model: one for each device, lens and size.
    pub cameras: u64,
    /// Mean distance of points from where photographs show them, in pixels.
    pub reprojection_error: f64,
    /// Pairs of photographs that show the same things.
    pub verified_pairs: u64,
    /// The program that found them.
    pub generator: String,
    /// Whether the child had no network.
    pub is_network_isolated: bool,
    /// The options.
    pub options: PoseOptions,
    /// COLMAP's model, in its binary form: cameras, images, points.
    #[serde(skip)]
    pub model: PathBuf,
}

impl PoseReport {
    /// The progress of the finished search.
    #[must_use]
    pub fn progress(&self) -> PoseProgress {
        PoseProgress {
            stage: PoseStage::Mapping,
            done: self.registered.len() as u64,
            total: self.photographs as u64,
            reprojection_error: Some(self.reprojection_error),
        }
    }
}
