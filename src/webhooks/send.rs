//! One attempt: a signed request to an address that has been looked at.
//!
//! The policy is asked three times: of the URL's text, of every address that its host's name stands for, and of literal
//! addresses, which no resolver sees. The connection goes to the very addresses that were looked at, so a name that changes its
//! mind in between gains nothing.

use std::{error::Error, io, net::IpAddr, net::SocketAddr, sync::Arc, time::Duration};

use futures_util::future::BoxFuture;
use reqwest::{
    dns::{Addrs, Name, Resolve, Resolving},
    header::{CONTENT_TYPE, RETRY_AFTER},
    redirect::Policy,
};
use thiserror::Error;

use super::sign::{SecretFault, sign};
use crate::{
    domain::{OutboundFault, OutboundPolicy},
    https::{self, ExtraRoots},
    store::DueDelivery,
};

/// Asks for the addresses of a name.
pub type Lookup = Arc<dyn Fn(String) -> BoxFuture<'static, io::Result<Vec<IpAddr>>> + Send + Sync>;

/// Asks as the operating system does.
#[must_use]
pub fn system_lookup() -> Lookup {
    Arc::new(|name| {
        Box::pin(async move {
            let found = tokio::net::lookup_host((name.as_str(), 0)).await?;
            Ok(found.map(|address| address.ip()).collect())
        })
    })
}

/// Why an attempt got no answer. What it says is shown to the endpoint's owner.
#[derive(Debug, Error)]
pub enum SendError {
    /// The endpoint may not be asked.
    #[error("the address {0}")]
    Refused(#[from] OutboundFault),
    /// The message cannot be signed.
    #[error(transparent)]
    Secret(#[from] SecretFault),
    /// No answer in time.
    #[error("no answer within {0} s")]
    Timeout(u64),
    /// No connection, or none with TLS.
    #[error("no connection to the endpoint")]
    Connect,
    /// Who answered cannot show who they are.
    #[error("the endpoint's certificate {0}")]
    Certificate(&'static str),
    /// The connection broke, or what came was not HTTP.
    #[error("the connection broke before there was an answer")]
    Broken,
}

/// What an endpoint answered; its body is not read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Answered {
    /// The status.
    pub(super) status: u16,
    /// `Retry-After` as it came.
    pub(super) retry_after: Option<String>,
}

/// Makes attempts; clones share what they need.
#[derive(Debug, Clone)]
pub struct Sender {
    client: reqwest::Client,
    policy: OutboundPolicy,
    limit: Duration,
}

impl Sender {
    /// A sender that gives an attempt so much time and trusts the system's authorities and `roots`.
    ///
    /// # Errors
    /// If there is no client with TLS to be had.
    pub fn new(
        policy: OutboundPolicy,
        lookup: Lookup,
        limit: Duration,
        roots: &ExtraRoots,
    ) -> Result<Self, Box<dyn Error>> {
        let client = https::client_builder_trusting(roots)?
            .dns_resolver(Arc::new(Checked { policy, lookup }))
            .redirect(Policy::none())
            // A proxy would ask in its own name for addresses that nobody here has looked at.
            .no_proxy()
            // Nothing is kept open for the next message, which may be hours away.
            .pool_max_idle_per_host(0)
            .timeout(limit)
            .build()?;
        Ok(Self { client, policy, limit })
    }

    /// Sends a message and waits for the answer's head.
    pub(super) async fn send(&self, due: &DueDelivery) -> Result<Answered, SendError> {
        let url = self.policy.check_url(&due.url)?;
        let (id, timestamp) = (due.id.to_string(), due.at.as_second());
        let signature = sign(&due.secret, &id, timestamp, &due.body)?;
        let request = self
            .client
            .post(url)
            .header(CONTENT_TYPE, "application/json")
            .header("webhook-id", id)
            .header("webhook-timestamp", timestamp)
            .header("webhook-signature", signature)
            .body(due.body.clone());
        let response = request.send().await.map_err(|error| self.fault(&error))?;
        let retry_after = response.headers().get(RETRY_AFTER).and_then(|value| value.to_str().ok());
        Ok(Answered { status: response.status().as_u16(), retry_after: retry_after.map(str::to_owned) })
    }

    fn fault(&self, error: &reqwest::Error) -> SendError {
        let mut source = error.source();
        while let Some(cause) = source {
            if let Some(refused) = cause.downcast_ref::<OutboundFault>() {
                return refused.clone().into();
            }
            source = cause.source();
        }
        if let Some(reason) = https::certificate_fault(error) {
            return SendError::Certificate(reason);
        }
        match () {
            () if error.is_timeout() => SendError::Timeout(self.limit.as_secs()),
            () if error.is_connect() => SendError::Connect,
            () => SendError::Broken,
        }
    }
}

/// Finds addresses and refuses a name of which any is not allowed.
struct Checked {
    policy: OutboundPolicy,
    lookup: Lookup,
}

impl Resolve for Checked {
    fn resolve(&self, name: Name) -> Resolving {
        let (policy, found) = (self.policy, (self.lookup)(name.as_str().to_owned()));
        Box::pin(async move {
            let found = found.await?;
            for address in &found {
                policy.check_address(*address)?;
            }
            // The port is the URL's.
            let addresses = found.into_iter().map(|address| SocketAddr::new(address, 0));
            Ok(Box::new(addresses) as Addrs)
        })
    }
}
