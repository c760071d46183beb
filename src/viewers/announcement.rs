//! A viewer tells the database that it is alive, until it stops.

use std::{error::Error, time::Duration};

use tokio::time::sleep;
use tokio_util::sync::CancellationToken;

use crate::store::{Store, ViewerRecord};

/// How often a viewer is announced; it counts as alive for several times as long ([`crate::store::VIEWER_LIFE`]).
pub const ANNOUNCE_EVERY: Duration = Duration::from_secs(5);

/// Announces a viewer until `shutdown`, then withdraws it, so that replicas ask others before it stops to answer.
pub async fn announce(store: Store, viewer: ViewerRecord, shutdown: CancellationToken) {
    while !shutdown.is_cancelled() {
        if let Err(error) = store.announce_viewer(&viewer).await {
            tracing::warn!(error = &error as &dyn Error, "this viewer cannot be announced: {error}");
        }
        tokio::select! {
            () = sleep(ANNOUNCE_EVERY) => {}
            () = shutdown.cancelled() => {}
        }
    }
    if let Err(error) = store.withdraw_viewer(&viewer).await {
        tracing::warn!(error = &error as &dyn Error, "this viewer cannot be withdrawn: {error}");
    }
}
