//! What requests that may be sent twice have made, so that the second is answered like the first.
//!
//! What always holds: the row is written in the transaction that makes the thing, so there is never one without the other,
//! and (owner, key) is unique, so two requests with one key make one thing, whichever processes they reach.

use super::StoreFuture;
use crate::domain::{Digest, KeyId};

/// A request's claim on its `Idempotency-Key`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdempotentRequest {
    /// Whose key it is.
    pub owner: Option<KeyId>,
    /// What the client chose.
    pub key: String,
    /// SHA-256 of what the request asks for.
    pub fingerprint: Digest,
}

/// What a request with a key made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PriorRequest {
    /// SHA-256 of what that request asked for.
    pub fingerprint: Digest,
    /// HTTP status that it was answered with.
    pub status: u16,
    /// Identity of what it made.
    pub resource: String,
}

/// Part of a [`super::Store`]: what requests with an `Idempotency-Key` made.
pub trait Idempotency: Send + Sync + 'static {
    /// What the owner's request with this key made, unless [`super::QueuePolicy::idempotency_ttl`] has passed since.
    fn prior_request<'a>(
        &'a self,
        owner: Option<KeyId>,
        key: &'a str,
    ) -> StoreFuture<'a, Option<PriorRequest>>;
}
