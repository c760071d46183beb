//! Gives up queued jobs whose deadline has passed, also while every worker is busy or there is none.

use std::{sync::Arc, time::Duration};

use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use crate::store::Store;

/// Looks for such jobs every so often until `shutdown`.
pub(super) async fn give_up(store: Arc<dyn Store>, every: Duration, shutdown: CancellationToken) {
    let mut tick = interval(every);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            () = shutdown.cancelled() => return,
            _ = tick.tick() => {}
        }
        match store.give_up_overdue().await {
            Ok(0) => {}
            Ok(count) => tracing::info!(count, "{count} jobs are given up: their deadline has passed"),
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, "overdue jobs stay: {error}");
            }
        }
    }
}
