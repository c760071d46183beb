//! The processes that render views and exports for API replicas, as the database knows them.

use std::time::Duration;

use crate::domain::ViewerToken;

/// How long a viewer counts as alive after it was last announced.
pub const VIEWER_LIFE: Duration = Duration::from_secs(20);

/// A viewer process.
#[derive(Debug, Clone)]
pub struct ViewerRecord {
    /// Where replicas reach it, without a trailing slash. A viewer that restarts at its address takes its row over.
    pub url: String,
    /// The version of its program; replicas of another version do not ask it.
    pub version: String,
    /// What determines the bits of its pictures beside scene and camera: version, adapter and driver.
    pub identity: String,
    /// What it expects of whoever asks it for pictures.
    pub token: ViewerToken,
}
