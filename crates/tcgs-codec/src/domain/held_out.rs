//! Pictures of held-out views, from which a job's report is made without dataset or adapter.

use serde::{Deserialize, Serialize};

use super::{Camera, ViewScore};

/// Some of the held-out views, worst first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HeldOut {
    /// Held-out views in all.
    pub of: usize,
    /// The error, as a fraction of full range, that has the last color of `ramp`; larger ones have it too.
    pub ceiling: f64,
    /// Colors of errors from none to `ceiling`, evenly spaced.
    pub ramp: Vec<[u8; 3]>,
    /// The views.
    pub views: Vec<HeldOutView>,
}

/// One view. The pictures are JPEG files in base64, of one size, at most 512 pixels per side.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HeldOutView {
    /// Its name and figures, which were measured at full size.
    pub score: ViewScore,
    /// Its camera.
    pub camera: Camera,
    /// Width of the pictures.
    pub width: u32,
    /// Height of the pictures.
    pub height: u32,
    /// The photograph, over the job's background.
    pub photograph: String,
    /// The decoded scene from the same camera.
    pub render: String,
    /// The error of each pixel by color: root mean square over the channels.
    pub error: String,
}
