//! Answers that go on for long end soon after the key that they were asked for with is revoked.

use tokio::time::sleep;

use super::state::AppState;
use crate::domain::KeyId;

/// Ends once the key is revoked, which is looked at every [`super::config::RequestLimits::recheck_keys_every`]; never without a key.
pub(super) async fn revoked(state: AppState, key: Option<KeyId>) {
    let Some(key) = key else { return std::future::pending().await };
    loop {
        sleep(state.limits().recheck_keys_every).await;
        match state.store().key(key).await {
            Ok(Some(record)) if record.revoked_at.is_none() => {}
            Ok(_) => return,
            Err(error) => {
                tracing::warn!(%key, error = &error as &dyn std::error::Error, "cannot look key {key} up: {error}");
            }
        }
    }
}
