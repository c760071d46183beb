//! Where the server listens and what it bears.

use std::{
    net::{Ipv4Addr, SocketAddr},
    time::Duration,
};

use thiserror::Error;

/// The server's settings.
#[derive(Debug, Clone)]
pub struct HttpConfig {
    /// Where to listen.
    pub listen: SocketAddr,
    /// Connections served at a time; more wait in the system's queue.
    pub max_connections: usize,
    /// Longest time from a connection's begin, or from the previous response, to the end of a request's headers.
    pub header_timeout: Duration,
    /// Longest time that open requests may take once the server shuts down.
    pub drain: Duration,
    /// Bounds on requests.
    pub limits: RequestLimits,
}

impl Default for HttpConfig {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 8080)),
            max_connections: 512,
            header_timeout: Duration::from_secs(10),
            drain: Duration::from_secs(20),
            limits: RequestLimits::default(),
        }
    }
}

impl HttpConfig {
    /// Checks that the address may be served.
    ///
    /// # Errors
    /// [`ExposureError`] for an address that others can reach, because there are no keys to tell them apart.
    pub fn check_exposure(&self) -> Result<(), ExposureError> {
        if self.listen.ip().to_canonical().is_loopback() {
            return Ok(());
        }
        Err(ExposureError(self.listen))
    }
}

/// An address that must not be served without keys.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error(
    "{0} can be reached from other machines, and this version has no API keys: listen on a loopback address such as \
     127.0.0.1:8080, and let a proxy that authenticates stand between it and the network"
)]
pub struct ExposureError(pub SocketAddr);

/// Bounds on what one request may ask for.
#[derive(Debug, Clone)]
pub struct RequestLimits {
    /// Longest dataset archive, in bytes.
    pub upload_bytes: u64,
    /// Longest dataset archive that comes in parts, in bytes.
    pub resumable_bytes: u64,
    /// How long an upload waits for its next part.
    pub upload_life: Duration,
    /// Archives received at a time.
    pub uploads: usize,
    /// Longest JSON body, in bytes.
    pub json_bytes: u64,
    /// Longest pause within a body.
    pub body_idle: Duration,
    /// Longest time for a whole body.
    pub body_total: Duration,
    /// Longest side of a view, in pixels.
    pub view_side: u32,
    /// Pixels of all views of a request together.
    pub view_pixels: u64,
    /// Views of a request.
    pub views: usize,
    /// View requests that render at a time.
    pub renders: usize,
    /// View requests that may wait for their turn.
    pub renders_waiting: usize,
    /// How often changes of jobs are looked for while a request waits for one.
    pub watch_every: Duration,
    /// Requests that may wait for a job at a time; one more is answered at once.
    pub waits: usize,
}

impl Default for RequestLimits {
    fn default() -> Self {
        Self {
            upload_bytes: 4 << 30,
            resumable_bytes: 64 << 30,
            upload_life: Duration::from_secs(24 * 3600),
            uploads: 8,
            json_bytes: 1 << 20,
            body_idle: Duration::from_secs(30),
            body_total: Duration::from_secs(3600),
            view_side: 4096,
            view_pixels: 1 << 24,
            views: 64,
            renders: 1,
            renders_waiting: 32,
            watch_every: Duration::from_millis(250),
            waits: 128,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_loopback_is_served_without_keys() {
        let on = |listen: &str| HttpConfig {
            listen: listen.parse().expect("an address"),
            ..HttpConfig::default()
        };
        for listen in ["127.0.0.1:8080", "127.9.9.9:1", "[::1]:8080", "[::ffff:127.0.0.1]:80"] {
            assert_eq!(on(listen).check_exposure(), Ok(()), "{listen}");
        }
        for listen in ["0.0.0.0:8080", "[::]:8080", "192.168.1.4:8080", "[::ffff:10.0.0.1]:80"] {
            let config = on(listen);
            assert_eq!(config.check_exposure(), Err(ExposureError(config.listen)), "{listen}");
        }
    }
}
