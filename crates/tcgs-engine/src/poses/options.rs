//! Options and limits of the search for cameras.

use std::time::Duration;

use serde::Serialize;

use tcgs_codec::named_choice;

named_choice! {
    /// COLMAP's camera models that training reads.
    pub enum CameraModel {
        /// A focal length and one term of radial distortion: the safest choice for a telephone or a camera.
        SimpleRadial = "simple-radial",
        /// A focal length.
        SimplePinhole = "simple-pinhole",
        /// A focal length an axis.
        Pinhole = "pinhole",
        /// A focal length and two terms of radial distortion.
        Radial = "radial",
        /// A focal length an axis, two terms of radial and two of tangential distortion.
        Opencv = "opencv",
    }
}

impl CameraModel {
    /// As COLMAP calls it.
    #[must_use]
    pub fn colmap_name(self) -> String {
        self.name().replace('-', "_").to_uppercase()
    }
}

named_choice! {
    /// Which pairs of photographs are compared.
    pub enum Matching {
        /// Every pair of up to 200 photographs, else neighbors.
        Auto = "auto",
        /// Every pair.
        Exhaustive = "exhaustive",
        /// Each photograph and those after it in the order of names, and evenly spread ones with each other, so that loops close.
        Sequential = "sequential",
    }
}

impl Matching {
    /// The pairs of frames of a video: neighbors unless others are asked for.
    pub(super) fn of_a_video(self) -> Self {
        match self {
            Self::Auto => Self::Sequential,
            chosen => chosen,
        }
    }
}

/// Everything that decides which cameras are found, besides the photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct PoseOptions {
    /// The model of every camera.
    pub camera_model: CameraModel,
    /// Which pairs are compared.
    pub matching: Matching,
    /// Seed of every random choice.
    pub seed: u64,
    /// Threads.
    pub threads: usize,
    /// Frames of a video that are taken.
    pub frames: usize,
}

/// Frames of a video that are taken unless another number is given.
pub const DEFAULT_FRAMES: usize = 200;

/// What the child may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PoseLimits {
    /// Bytes of memory; 0 for no limit.
    pub memory_bytes: u64,
    /// Time until the work is given up.
    pub time: Duration,
}
