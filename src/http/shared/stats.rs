//! The store's statistics, cached, so that scrapers cannot keep the database busy.

use std::time::{Duration, Instant};

use tokio::sync::Mutex;

use crate::{
    http::problem::ApiResult,
    store::{Store, StoreStats},
};

/// How long the statistics are cached.
const CACHE_TIME: Duration = Duration::from_secs(1);

/// The statistics, read at most once in [`CACHE_TIME`].
pub(crate) struct StatsCache {
    store: Store,
    latest: Mutex<Option<(Instant, StoreStats)>>,
}

impl StatsCache {
    /// A cache that has read nothing yet.
    pub(crate) fn new(store: Store) -> Self {
        Self { store, latest: Mutex::default() }
    }

    /// The statistics. Concurrent callers wait for the same read.
    ///
    /// # Errors
    /// If the database cannot be read.
    pub(crate) async fn get(&self) -> ApiResult<StoreStats> {
        let mut latest = self.latest.lock().await;
        if let Some((at, stats)) = &*latest
            && at.elapsed() < CACHE_TIME
        {
            return Ok(stats.clone());
        }
        let stats = self.store.stats().await?;
        *latest = Some((Instant::now(), stats.clone()));
        Ok(stats)
    }
}
