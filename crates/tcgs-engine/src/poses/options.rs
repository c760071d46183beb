//! Options and limits of the search for cameras.

use std::time::Duration;

use serde::Serialize;

use crate::domain::{CameraModel, Matching};

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
