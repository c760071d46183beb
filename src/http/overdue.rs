//! Ends what time ends, also while every worker is busy or there is none: gives up queued jobs whose deadline has passed, and takes
//! running ones from workers that have fallen silent.

use std::{sync::Arc, time::Duration};

use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use crate::store::{Store, StoreError};

/// Looks for such jobs every so often until `shutdown`.
pub(super) async fn give_up(store: Arc<dyn Store>, every: Duration, shutdown: CancellationToken) {
    let mut tick = interval(every);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            () = shutdown.cancelled() => return,
            _ = tick.tick() => {}
        }
        tell(store.fail_expired().await, "given up: their deadline has passed");
        tell(store.expire_leases().await, "taken from workers that have fallen silent");
    }
}

fn tell(done: Result<u64, StoreError>, what: &str) {
    match done {
        Ok(0) => {}
        Ok(count) => tracing::info!(count, "{count} jobs are {what}"),
        Err(error) => {
            tracing::warn!(
                error = &error as &dyn std::error::Error,
                "jobs stay that were to be {what}: {error}"
            );
        }
    }
}
