//! The processes that render views and exports for API replicas, as the database knows them.

use std::time::Duration;

use super::StoreFuture;
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

/// The part of a store that knows the viewers. Every method is one transaction.
pub trait Viewers: Send + Sync + 'static {
    /// Records that a viewer is alive now, and forgets those that were not for an hour.
    fn announce_viewer<'a>(&'a self, viewer: &'a ViewerRecord) -> StoreFuture<'a, ()>;

    /// The viewers that were announced within [`VIEWER_LIFE`], by their URLs.
    fn live_viewers(&self) -> StoreFuture<'_, Vec<ViewerRecord>>;

    /// Forgets a viewer that stops, unless another process has taken its URL over.
    fn withdraw_viewer<'a>(&'a self, viewer: &'a ViewerRecord) -> StoreFuture<'a, ()>;
}
