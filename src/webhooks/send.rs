//! One attempt: a signed request to an address that the policy allows.
//!
//! The policy checks the URL, literal addresses in it (which no resolver sees), and every address that its host name resolves to. The
//! connection uses the checked addresses, so a name that resolves differently later (DNS rebinding) has no effect.

use std::{error::Error, io, net::IpAddr, net::SocketAddr, sync::Arc, time::Duration};

use futures_util::future::BoxFuture;
use reqwest::{
    dns::{Addrs, Name, Resolve, Resolving},
    header::{CONTENT_TYPE, RETRY_AFTER},
    redirect::Policy,
};
use thiserror::Error;

use super::sign::{InvalidSecretError, sign};
use crate::{
    domain::{OutboundError, OutboundPolicy},
    https::{self, ExtraRoots},
    store::DueDelivery,
};

/// Resolves a host name.
pub type Lookup = Arc<dyn Fn(String) -> BoxFuture<'static, io::Result<Vec<IpAddr>>> + Send + Sync>;

/// Resolves by the operating system.
#[must_use]
pub fn system_lookup() -> Lookup {
    Arc::new(|name| {
        Box::pin(async move {
            let found = tokio::net::lookup_host((name.as_str(), 0)).await?;
            Ok(found.map(|address| address.ip()).collect())
        })
    })
}

/// Why an attempt got no response. The message is shown to the endpoint's owner.
#[derive(Debug, Error)]
pub enum SendError {
    /// The policy forbids the address.
    #[error("the address {0}")]
    Refused(#[from] OutboundError),
    /// The message cannot be signed.
    #[error(transparent)]
    Secret(#[from] InvalidSecretError),
    /// No response in time.
    #[error("no response within {0} s")]
    Timeout(u64),
    /// No connection, or none with TLS.
    #[error("no connection to the endpoint")]
    Connect,
    /// The certificate is not valid for the endpoint.
    #[error("the endpoint's certificate {0}")]
    Certificate(&'static str),
    /// The connection was lost, or the response was not HTTP.
    #[error("the connection was lost before a response")]
    Broken,
}

/// An endpoint's response; its body is not read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Response {
    pub(super) status: u16,
    /// The `Retry-After` header, if there was one.
    pub(super) retry_after: Option<String>,
}

/// Sends messages; clones share the client.
#[derive(Debug, Clone)]
pub struct Sender {
    client: reqwest::Client,
    policy: OutboundPolicy,
    limit: Duration,
}

impl Sender {
    /// A sender that gives each attempt the time `limit` and trusts the system's certificate authorities and `roots`.
    ///
    /// # Errors
    /// If no TLS client can be built.
    pub fn new(
        policy: OutboundPolicy,
        lookup: Lookup,
        limit: Duration,
        roots: &ExtraRoots,
    ) -> Result<Self, Box<dyn Error>> {
        let client = https::client_builder_trusting(roots)?
            .dns_resolver(Arc::new(CheckedResolver { policy, lookup }))
            .redirect(Policy::none())
            // A proxy would resolve names itself, unchecked.
            .no_proxy()
            // The next message may be hours away.
            .pool_max_idle_per_host(0)
            .timeout(limit)
            .build()?;
        Ok(Self { client, policy, limit })
    }

    /// Sends a message and waits for the response's head.
    pub(super) async fn send(&self, due: &DueDelivery) -> Result<Response, SendError> {
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
        let response = request.send().await.map_err(|error| self.send_error(&error))?;
        let retry_after = response.headers().get(RETRY_AFTER).and_then(|value| value.to_str().ok());
        Ok(Response { status: response.status().as_u16(), retry_after: retry_after.map(str::to_owned) })
    }

    fn send_error(&self, error: &reqwest::Error) -> SendError {
        let mut source = error.source();
        while let Some(cause) = source {
            if let Some(refused) = cause.downcast_ref::<OutboundError>() {
                return refused.clone().into();
            }
            source = cause.source();
        }
        if let Some(reason) = https::certificate_error(error) {
            return SendError::Certificate(reason);
        }
        match () {
            () if error.is_timeout() => SendError::Timeout(self.limit.as_secs()),
            () if error.is_connect() => SendError::Connect,
            () => SendError::Broken,
        }
    }
}

/// Resolves names, and refuses a name if the policy forbids any of its addresses.
struct CheckedResolver {
    policy: OutboundPolicy,
    lookup: Lookup,
}

impl Resolve for CheckedResolver {
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
