//! Which requests with an `Idempotency-Key` are in flight in this process.

use std::{
    collections::BTreeSet,
    sync::{Arc, Mutex, PoisonError},
};

use crate::domain::ProjectId;

/// A key within the project that chose it.
pub(crate) type ScopedKey = (ProjectId, String);

/// The keys of requests in flight; clones share them.
#[derive(Debug, Clone, Default)]
pub(crate) struct InFlight(Arc<Mutex<BTreeSet<ScopedKey>>>);

/// A request's key, in flight until this is dropped.
#[derive(Debug)]
pub(crate) struct IdempotencyGuard {
    in_flight: InFlight,
    key: ScopedKey,
}

impl InFlight {
    /// Puts a key in flight; `None` while another request with it is.
    pub(crate) fn begin(&self, key: ScopedKey) -> Option<IdempotencyGuard> {
        let is_new = self.0.lock().unwrap_or_else(PoisonError::into_inner).insert(key.clone());
        is_new.then(|| IdempotencyGuard { in_flight: self.clone(), key })
    }
}

impl IdempotencyGuard {
    /// The key.
    pub(crate) fn key(&self) -> &ScopedKey {
        &self.key
    }
}

impl Drop for IdempotencyGuard {
    fn drop(&mut self) {
        self.in_flight.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.key);
    }
}
