//! Fails queued jobs whose deadline has passed, and ends the leases of silent workers, also while every worker is busy or there is none.

use std::time::Duration;

use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use crate::store::{Store, StoreError};

/// Checks for such jobs at an interval until `shutdown`.
pub(super) async fn enforce(store: Store, every: Duration, shutdown: CancellationToken) {
    let mut tick = interval(every);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            () = shutdown.cancelled() => return,
            _ = tick.tick() => {}
        }
        log(store.fail_expired().await, "failed: their deadline has passed");
        log(store.expire_leases().await, "taken from silent workers");
    }
}

fn log(done: Result<u64, StoreError>, what: &str) {
    match done {
        Ok(0) => {}
        Ok(count) => tracing::info!(count, "{count} jobs are {what}"),
        Err(error) => {
            tracing::warn!(error = &error as &dyn std::error::Error, "no jobs could be {what}: {error}");
        }
    }
}
