//! Webhook endpoints, and the outbox of deliveries to them.
//!
//! Invariant: a change of a job's state and its deliveries are committed in one transaction, so there is exactly one delivery for each
//! change and subscribed endpoint.

use std::time::Duration;

use jiff::Timestamp;

use crate::domain::{DeliveryId, EndpointId, JobId, ProjectId, WebhookEvent, WebhookSecret, named_choice};

/// Longer than any pause before another attempt ([`AfterAttempt::RetryAfter`]).
pub const MAX_PAUSE: Duration = Duration::from_secs(27 * 3600);

/// An endpoint to be added.
#[derive(Debug)]
pub struct NewEndpoint {
    /// Its identity, chosen by the caller.
    pub id: EndpointId,
    /// The project whose jobs it is notified of.
    pub project: ProjectId,
    /// Where messages are sent.
    pub url: String,
    /// The events that it subscribes to.
    pub events: Vec<WebhookEvent>,
    /// The user's description.
    pub description: Option<String>,
    /// The secret that signs messages.
    pub secret: WebhookSecret,
}

/// An endpoint, without its secret.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndpointRecord {
    /// As in [`NewEndpoint::id`].
    pub id: EndpointId,
    /// As in [`NewEndpoint::project`].
    pub project: ProjectId,
    /// As in [`NewEndpoint::url`].
    pub url: String,
    /// As in [`NewEndpoint::events`].
    pub events: Vec<WebhookEvent>,
    /// As in [`NewEndpoint::description`].
    pub description: Option<String>,
    pub created_at: Timestamp,
    /// When it responded 410; it gets no messages since.
    pub disabled_at: Option<Timestamp>,
}

named_choice! {
    /// State of a delivery; the names are those in the database and the API.
    pub enum DeliveryState {
        /// An attempt is due or in progress.
        Pending = "pending",
        /// The endpoint has accepted it.
        Delivered = "delivered",
        /// Its attempts are used up, or the endpoint is disabled.
        Failed = "failed",
    }
}

/// A message to an endpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeliveryRecord {
    /// Counts over all deliveries; the order of creation.
    pub seq: u64,
    /// Its identity.
    pub id: DeliveryId,
    pub job: JobId,
    pub event: WebhookEvent,
    pub state: DeliveryState,
    /// Attempts started.
    pub attempts: u32,
    /// When the next attempt is due, while pending.
    pub due_at: Option<Timestamp>,
    /// Creation, in the transaction of its event.
    pub created_at: Timestamp,
    /// Start of the latest attempt.
    pub attempted_at: Option<Timestamp>,
    /// When the endpoint accepted it.
    pub delivered_at: Option<Timestamp>,
    /// Status of the latest response, if there was one.
    pub response_status: Option<u16>,
    /// Why the latest attempt failed.
    pub error: Option<String>,
}

/// Result of a request to deliver again.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Replay {
    /// It is due now.
    Due(DeliveryRecord),
    /// An attempt is in progress.
    InProgress,
    /// The endpoint is disabled.
    Disabled,
}

/// A leased delivery.
#[derive(Debug)]
pub struct DueDelivery {
    /// Its identity.
    pub id: DeliveryId,
    /// The attempt, to be named with its result.
    pub attempt: u32,
    /// Its position in the retry schedule, from 1.
    pub tries: u32,
    /// Where to send it.
    pub url: String,
    /// The secret to sign it with.
    pub secret: WebhookSecret,
    /// The message.
    pub body: String,
    /// The current time.
    pub at: Timestamp,
}

/// Result of an attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeliveryResult {
    /// Status of the response, if there was one.
    pub response_status: Option<u16>,
    /// Why it failed, if it did.
    pub error: Option<String>,
    /// What follows.
    pub next: AfterAttempt,
}

/// What follows an attempt to deliver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AfterAttempt {
    /// Nothing: it was accepted.
    Done,
    /// Another attempt after this time.
    RetryAfter(Duration),
    /// Nothing: its attempts are used up.
    GiveUp,
    /// Nothing, for this and all later messages: the endpoint is gone.
    DisableEndpoint,
}
