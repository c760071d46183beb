//! Tells endpoints of jobs as Standard Webhooks has it: what waits in the store's outbox is signed, sent, and sent again until it
//! is taken or given up.
//!
//! What always holds: a message is delivered at least once or its failure is on record; every attempt at it has the same id
//! and body; a request goes to an address that the policy allows, and to nothing that it redirects to; secrets are neither
//! logged nor sent. Several servers on one database share the work: a delivery is leased to one of them at a time.

mod schedule;
mod send;
mod sign;

use std::{sync::Arc, time::Duration};

use tokio::{
    task::JoinSet,
    time::{sleep, timeout},
};
use tokio_util::sync::CancellationToken;

pub use send::{Lookup, SendError, Sender, system_lookup};
pub use sign::{SecretFault, sign};

use crate::store::{DueDelivery, Store};

/// How deliveries are made.
#[derive(Debug, Clone)]
pub struct DeliveryConfig {
    /// How often the outbox is looked into.
    pub poll: Duration,
    /// Deliveries under way at a time; of one endpoint there is only one.
    pub at_once: usize,
    /// How long a delivery is this server's; longer than an attempt at it may take.
    pub lease: Duration,
    /// How long attempts under way may take once the server stops. One that is cut off is made again.
    pub drain: Duration,
}

impl Default for DeliveryConfig {
    fn default() -> Self {
        Self {
            poll: Duration::from_secs(1),
            at_once: 16,
            lease: Duration::from_secs(60),
            drain: Duration::from_secs(5),
        }
    }
}

/// Delivers what is due until `shutdown`.
pub async fn deliver(
    store: Arc<dyn Store>,
    sender: Sender,
    config: DeliveryConfig,
    shutdown: CancellationToken,
) {
    let mut under_way = JoinSet::new();
    while !shutdown.is_cancelled() {
        if under_way.len() < config.at_once {
            match store.take_delivery(config.lease).await {
                Ok(Some(due)) => {
                    under_way.spawn(attempt(Arc::clone(&store), sender.clone(), due));
                    continue;
                }
                Ok(None) => {}
                Err(error) => {
                    tracing::warn!(
                        error = &error as &dyn std::error::Error,
                        "no look into the outbox: {error}"
                    );
                }
            }
        }
        tokio::select! {
            () = sleep(config.poll) => {}
            () = shutdown.cancelled() => {}
            Some(ended) = under_way.join_next() => log_panic(ended),
        }
    }
    let rest = async {
        while let Some(ended) = under_way.join_next().await {
            log_panic(ended);
        }
    };
    if timeout(config.drain, rest).await.is_err() {
        tracing::warn!("some webhooks were cut off; they will be sent again");
    }
}

async fn attempt(store: Arc<dyn Store>, sender: Sender, due: DueDelivery) {
    let sent = sender.send(&due).await;
    let settled = schedule::settle(&due, sent);
    let (delivery, status) = (due.id, settled.status);
    match &settled.fault {
        None => tracing::info!(%delivery, attempt = due.attempt, status, "webhook {delivery} is delivered"),
        Some(fault) => {
            tracing::info!(%delivery, attempt = due.attempt, status, "webhook {delivery} is not delivered: {fault}");
        }
    }
    if let Err(error) = store.finish_delivery(due.id, due.attempt, settled).await {
        // Its lease will run out, and it will be sent again.
        tracing::warn!(%delivery, error = &error as &dyn std::error::Error, "webhook {delivery}: {error}");
    }
}

fn log_panic(ended: Result<(), tokio::task::JoinError>) {
    if let Err(error) = ended {
        tracing::error!("a delivery panicked: {error}");
    }
}
