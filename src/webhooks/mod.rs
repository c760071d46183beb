//! Delivers webhooks by the Standard Webhooks specification: signs and sends the messages of the store's outbox, with retries.
//!
//! Invariants: a message is delivered at least once or its failure is recorded; all attempts of a message have the same id and body;
//! requests go only to addresses that the policy allows, and redirections are not followed; secrets are neither logged nor sent.
//! Several servers on one database share the work: a delivery is leased to one of them at a time.

mod schedule;
mod send;
mod sign;

use std::{error::Error, time::Duration};

use tokio::{
    task::JoinSet,
    time::{sleep, timeout},
};
use tokio_util::sync::CancellationToken;

pub use send::{Lookup, SendError, Sender, system_lookup};
pub use sign::{InvalidSecretError, sign};

use crate::{
    domain::with_defaults,
    store::{DueDelivery, Store},
};

with_defaults! {
    /// How deliveries are made.
    #[derive(Debug, Clone)]
    pub struct DeliveryConfig {
        /// Polling interval of the outbox.
        pub poll: Duration = Duration::from_secs(1),
        /// Concurrent deliveries; at most one per endpoint.
        pub max_concurrent: usize = 16,
        /// How long a delivery is leased; longer than an attempt may take.
        pub lease: Duration = Duration::from_secs(60),
        /// How long running attempts may take once the server stops. An interrupted attempt is repeated later.
        pub drain: Duration = Duration::from_secs(5),
    }
}

/// Delivers what is due until `shutdown`.
pub async fn deliver(store: Store, sender: Sender, config: DeliveryConfig, shutdown: CancellationToken) {
    let mut running = JoinSet::new();
    while !shutdown.is_cancelled() {
        if running.len() < config.max_concurrent {
            match store.take_delivery(config.lease).await {
                Ok(Some(due)) => {
                    running.spawn(attempt(store.clone(), sender.clone(), due));
                    continue;
                }
                Ok(None) => {}
                Err(error) => {
                    tracing::warn!(error = &error as &dyn Error, "the outbox cannot be read: {error}");
                }
            }
        }
        tokio::select! {
            () = sleep(config.poll) => {}
            () = shutdown.cancelled() => {}
            Some(ended) = running.join_next() => log_panic(ended),
        }
    }
    let rest = async {
        while let Some(ended) = running.join_next().await {
            log_panic(ended);
        }
    };
    if timeout(config.drain, rest).await.is_err() {
        tracing::warn!("some webhooks were interrupted; they will be sent again");
    }
}

async fn attempt(store: Store, sender: Sender, due: DueDelivery) {
    let sent = sender.send(&due).await;
    let result = schedule::result_of(&due, sent);
    let (delivery, status) = (due.id, result.response_status);
    match &result.error {
        None => tracing::info!(%delivery, attempt = due.attempt, status, "webhook {delivery} delivered"),
        Some(error) => {
            tracing::info!(%delivery, attempt = due.attempt, status, "webhook {delivery} failed: {error}");
        }
    }
    if let Err(error) = store.finish_delivery(due.id, due.attempt, result).await {
        // Its lease will expire, and it will be sent again.
        tracing::warn!(%delivery, error = &error as &dyn Error, "webhook {delivery}: {error}");
    }
}

fn log_panic(ended: Result<(), tokio::task::JoinError>) {
    if let Err(error) = ended {
        tracing::error!("a delivery panicked: {error}");
    }
}
