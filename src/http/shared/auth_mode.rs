//! Whether the service requires keys.

use std::sync::atomic::{AtomicBool, Ordering};

use crate::{http::problem::ApiResult, store::Store};

/// Whether the database had any key when last read. Keys are never removed from it.
pub(crate) struct AuthMode {
    store: Store,
    /// Whether requests without a key are served even if there are keys.
    without_keys: bool,
    has_keys: AtomicBool,
}

impl AuthMode {
    /// The mode of a service whose keys have not been read yet.
    pub(crate) fn new(store: Store, without_keys: bool) -> Self {
        Self { store, without_keys, has_keys: AtomicBool::new(false) }
    }

    /// Reads whether there are keys, before the first request.
    pub(crate) async fn load(&self) {
        if let Err(error) = self.allows_anonymous().await {
            tracing::warn!("cannot read yet whether there are keys: {error:?}");
        }
    }

    /// Whether there were keys when last read.
    pub(crate) fn requires_keys(&self) -> bool {
        self.has_keys.load(Ordering::Relaxed)
    }

    /// Whether a request without a key is served.
    ///
    /// # Errors
    /// If the database cannot be read.
    pub(crate) async fn allows_anonymous(&self) -> ApiResult<bool> {
        if self.requires_keys() {
            return Ok(false);
        }
        if self.without_keys {
            return Ok(true);
        }
        let has_keys = self.store.has_keys().await?;
        self.has_keys.store(has_keys, Ordering::Relaxed);
        Ok(!has_keys)
    }
}
