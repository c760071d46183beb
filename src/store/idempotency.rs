//! Requests with an `Idempotency-Key`, so that a repeated request is answered like the first.
//!
//! Invariants: the row is written in the transaction that creates the resource, so neither exists without the other; (project, key) is
//! unique, so two requests with one key create one resource, whichever processes they reach.

use crate::domain::{Digest, ProjectId};

/// A request with an `Idempotency-Key`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdempotentRequest {
    /// The project of its key.
    pub project: ProjectId,
    /// The key that the client chose.
    pub key: String,
    /// SHA-256 of the request.
    pub fingerprint: Digest,
}

/// An earlier request with the same key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PriorRequest {
    /// SHA-256 of that request.
    pub fingerprint: Digest,
    /// HTTP status of its response.
    pub status: u16,
    /// Identity of the resource that it created.
    pub resource: String,
}
