//! Ends long responses soon after the key or the link of their request is revoked or has expired.

use tokio::time::sleep;

use crate::{domain::Credential, http::state::AppState, store::StoreError};

/// Returns once the credential is no longer valid, which is checked every [`crate::http::config::RequestLimits::key_recheck_interval`]; never returns without one.
pub(crate) async fn revoked(state: AppState, credential: Credential) {
    if credential == Credential::None {
        return std::future::pending().await;
    }
    loop {
        sleep(state.limits.key_recheck_interval).await;
        match is_valid(&state, credential).await {
            Ok(true) => {}
            Ok(false) => return,
            Err(error) => {
                tracing::warn!(
                    ?credential,
                    error = &error as &dyn std::error::Error,
                    "cannot look the credential of a stream up: {error}"
                );
            }
        }
    }
}

async fn is_valid(state: &AppState, credential: Credential) -> Result<bool, StoreError> {
    let store = state.store();
    match credential {
        Credential::None => Ok(true),
        Credential::Key(key) => {
            let now = store.time().await?;
            Ok(store.key(key).await?.is_some_and(|record| record.is_valid(now)))
        }
        // Links that are over are not found.
        Credential::Link(link) => Ok(store.share(link).await?.is_some()),
    }
}
