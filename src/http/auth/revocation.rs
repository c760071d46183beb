//! Ends long responses soon after the key of their request is revoked or has expired.

use tokio::time::sleep;

use crate::{domain::KeyId, http::state::AppState};

/// Returns once the key is no longer valid, which is checked every [`crate::http::config::RequestLimits::key_recheck_interval`]; never returns without a key.
pub(crate) async fn revoked(state: AppState, key: Option<KeyId>) {
    let Some(key) = key else { return std::future::pending().await };
    loop {
        sleep(state.limits.key_recheck_interval).await;
        match state.store().key(key).await {
            Ok(Some(record)) if record.is_valid(state.services.clock.now()) => {}
            Ok(_) => return,
            Err(error) => {
                tracing::warn!(%key, error = &error as &dyn std::error::Error, "cannot look key {key} up: {error}");
            }
        }
    }
}
