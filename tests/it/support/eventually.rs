//! Waits with an end: what does not come about fails its test by name instead of letting it hang.

use std::{panic::Location, time::Duration};

/// How long anything is waited for. It comes about within seconds; a busy machine gets more.
pub const PATIENCE: Duration = Duration::from_secs(300);

const PAUSE: Duration = Duration::from_millis(5);

/// What the future comes to.
#[track_caller]
pub fn within<T>(what: &str, future: impl Future<Output = T>) -> impl Future<Output = T> {
    let caller = Location::caller();
    async move {
        let done = tokio::time::timeout(PATIENCE, future).await;
        done.unwrap_or_else(|_| panic!("{caller}: {what} has not come about in {PATIENCE:?}"))
    }
}

/// Asks until it is so.
#[track_caller]
pub fn eventually(what: &str, mut is_so: impl AsyncFnMut() -> bool) -> impl Future<Output = ()> {
    within(what, async move {
        while !is_so().await {
            tokio::time::sleep(PAUSE).await;
        }
    })
}
