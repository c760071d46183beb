//! Ends long responses soon after the key of their request is revoked or has expired.

use tokio::time::sleep;

use crate::{domain::KeyId, http::state::AppState, store::StoreError};

/// Returns once the key is no longer valid, which is checked every [`crate::http::config::RequestLimits::key_recheck_interval`]; never returns without a key.
pub(crate) async fn revoked(state: AppState, key: Option<KeyId>) {
    let Some(key) = key else { return std::future::pending().await };
    loop {
        sleep(state.limits.key_recheck_interval).await;
        match is_valid(&state, key).await {
            Ok(true) => {}
            Ok(false) => return,
            Err(error) => {
                tracing::warn!(%key, error = &error as &dyn std::error::Error, "cannot look key {key} up: {error}");
            }
        }
    }
}

async fn is_valid(state: &AppState, key: KeyId) -> Result<bool, StoreError> {
    let now = state.store().time().await?;
    Ok(state.store().key(key).await?.is_some_and(|record| record.is_valid(now)))
}
