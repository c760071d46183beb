//! Endpoints that want to be told of jobs, and the outbox of what they are to be told.
//!
//! What always holds: a change of a job's state and the rows that tell of it are committed together or not at all, so nothing
//! is told that did not happen and nothing that happened is forgotten.

use std::time::Duration;

use jiff::Timestamp;

use super::StoreFuture;
use crate::domain::{DeliveryId, EndpointId, JobId, KeyId, WebhookEvent, WebhookSecret};

/// The part of the store that keeps endpoints and deliveries.
pub trait Webhooks: Send + Sync + 'static {
    /// Adds an endpoint, unless its owner has `at_most` already.
    fn create_endpoint(&self, new: NewEndpoint, at_most: u32) -> StoreFuture<'_, Option<EndpointRecord>>;

    /// An endpoint.
    fn endpoint(&self, id: EndpointId) -> StoreFuture<'_, Option<EndpointRecord>>;

    /// Up to `limit` endpoints, of one owner if one is named, newest first, older than `before`.
    fn endpoints(
        &self,
        owner: Option<KeyId>,
        before: Option<EndpointId>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<EndpointRecord>>;

    /// Removes an endpoint with its deliveries and tells whether it was there.
    fn delete_endpoint(&self, id: EndpointId) -> StoreFuture<'_, bool>;

    /// Up to `limit` deliveries to an endpoint, newest first, with numbers below `before`.
    fn deliveries(
        &self,
        endpoint: EndpointId,
        before: Option<u64>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<DeliveryRecord>>;

    /// Makes a delivery due now, with its whole schedule before it; `None` if the endpoint has no such delivery.
    fn replay(&self, endpoint: EndpointId, id: DeliveryId) -> StoreFuture<'_, Option<Replay>>;

    /// Takes the delivery that has been due for longest, for as long as `lease`; at most one at a time of an endpoint.
    fn take_delivery(&self, lease: Duration) -> StoreFuture<'_, Option<DueDelivery>>;

    /// Records what an attempt came to. An attempt that was overtaken, or whose endpoint is gone, changes nothing.
    fn finish_delivery(&self, id: DeliveryId, attempt: u32, settled: DeliveryResult) -> StoreFuture<'_, ()>;
}

/// An endpoint to be added.
#[derive(Debug)]
pub struct NewEndpoint {
    /// Its identity, chosen by the caller.
    pub id: EndpointId,
    /// Whose jobs it is told of.
    pub owner: Option<KeyId>,
    /// Where messages go.
    pub url: String,
    /// What it is told of.
    pub events: Vec<WebhookEvent>,
    /// The owner's note.
    pub description: Option<String>,
    /// What messages are signed with.
    pub secret: WebhookSecret,
}

/// An endpoint, without its secret.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndpointRecord {
    /// As in [`NewEndpoint::id`].
    pub id: EndpointId,
    /// As in [`NewEndpoint::owner`].
    pub owner: Option<KeyId>,
    /// As in [`NewEndpoint::url`].
    pub url: String,
    /// As in [`NewEndpoint::events`].
    pub events: Vec<WebhookEvent>,
    /// As in [`NewEndpoint::description`].
    pub description: Option<String>,
    /// Creation.
    pub created_at: Timestamp,
    /// When it answered 410, after which it is told nothing.
    pub disabled_at: Option<Timestamp>,
}

/// How far a delivery is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeliveryState {
    /// An attempt will be made, or is being made.
    Pending,
    /// The endpoint has taken it.
    Delivered,
    /// It was given up.
    Failed,
}

impl DeliveryState {
    /// Every state.
    pub const ALL: [Self; 3] = [Self::Pending, Self::Delivered, Self::Failed];

    /// The name in the database and the API.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            DeliveryState::Pending => "pending",
            DeliveryState::Delivered => "delivered",
            DeliveryState::Failed => "failed",
        }
    }
}

/// A message to an endpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeliveryRecord {
    /// Counts over all deliveries; the order of creation.
    pub seq: u64,
    /// Its identity.
    pub id: DeliveryId,
    /// The job that it is about.
    pub job: JobId,
    /// What it tells.
    pub event: WebhookEvent,
    /// How far it is.
    pub state: DeliveryState,
    /// Attempts begun.
    pub attempts: u32,
    /// When the next attempt is due, while pending.
    pub due_at: Option<Timestamp>,
    /// Creation, in the transaction of what it tells of.
    pub created_at: Timestamp,
    /// Begin of the latest attempt.
    pub attempted_at: Option<Timestamp>,
    /// When the endpoint took it.
    pub delivered_at: Option<Timestamp>,
    /// Status of the latest answer, if there was one.
    pub answer_status: Option<u16>,
    /// Why the latest attempt failed.
    pub answer_fault: Option<String>,
}

/// What a request to deliver again came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Replay {
    /// It is due.
    Due(DeliveryRecord),
    /// An attempt is being made right now.
    UnderWay,
    /// The endpoint is disabled.
    Disabled,
}

/// A delivery whose time has come.
#[derive(Debug)]
pub struct DueDelivery {
    /// Its identity.
    pub id: DeliveryId,
    /// The attempt, to be named when it is settled.
    pub attempt: u32,
    /// Its place in the schedule, from 1.
    pub tries: u32,
    /// Where to.
    pub url: String,
    /// What to sign with.
    pub secret: WebhookSecret,
    /// The message.
    pub body: String,
    /// Now.
    pub at: Timestamp,
}

/// What an attempt came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeliveryResult {
    /// Status of the answer, if there was one.
    pub status: Option<u16>,
    /// Why it failed, if it did.
    pub fault: Option<String>,
    /// What follows.
    pub next: AfterAttempt,
}

/// What follows an attempt to deliver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AfterAttempt {
    /// Nothing: it was taken.
    Done,
    /// Another one, that much later.
    RetryAfter(Duration),
    /// Nothing: it has been tried often enough.
    GiveUp,
    /// Nothing, for this and all other messages: the endpoint is gone.
    DisableEndpoint,
}
