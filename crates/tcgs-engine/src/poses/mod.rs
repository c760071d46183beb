//! Cameras of photographs that have none: COLMAP's structure from motion, by pycolmap in a child process.
//!
//! Invariants: the child gets no network where the system permits that, keeps to a limit of memory, time and threads, and ends with
//! its parent; everything that it writes is below one folder of the caller's; the same photographs, options and seed on the same machine
//! give the same cameras, as far as pycolmap promises that.

mod child;
mod error;
mod natural_order;
mod options;

pub use child::{PoseEstimator, find_python};
pub use error::PosesError;
pub use natural_order::natural_order;
pub use options::{CameraModel, Matching, PoseLimits, PoseOptions};

#[cfg(all(test, unix))]
mod tests;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// The version of pycolmap that is tried and pinned.
pub const PYCOLMAP_VERSION: &str = "4.2.1";

/// Fewest photographs of which cameras can be found.
pub const MIN_PHOTOGRAPHS: usize = 3;

/// A phase of the work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PoseStage {
    /// Distinct points of each photograph are found.
    Features,
    /// Pairs of photographs are compared.
    Matches,
    /// Photographs are registered, one after the other.
    Mapping,
}

impl PoseStage {
    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Features => "features",
            Self::Matches => "matches",
            Self::Mapping => "mapping",
        }
    }
}

/// How far the work is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PoseProgress {
    /// The phase.
    pub stage: PoseStage,
    /// Photographs, pairs or registered photographs that are done; pairs of sequential matching are an estimate.
    pub done: u64,
    /// Of how many.
    pub total: u64,
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
