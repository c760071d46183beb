//! Settings of the server: addresses, timeouts and limits.

use std::{
    net::{Ipv4Addr, SocketAddr},
    num::NonZeroU32,
    time::Duration,
};

use thiserror::Error;

use super::{client_address::TrustedProxies, origins::AllowedOrigins};
use crate::domain::{OutboundPolicy, with_defaults};

with_defaults! {
    /// The server's settings.
    #[derive(Debug, Clone)]
    pub struct HttpConfig {
        /// Where to listen.
        pub listen: SocketAddr = SocketAddr::from((Ipv4Addr::LOCALHOST, 8080)),
        /// Where to serve `/metrics` without keys, instead of on the main listener.
        pub metrics_listen: Option<SocketAddr> = None,
        /// Connections served at a time; more wait in the system's queue.
        pub max_connections: usize = 512,
        /// Connections of one address, or one IPv6 network of 64 bits, served at a time; more are closed. Trusted proxies have no such
        /// bound.
        pub max_connections_per_address: usize = 128,
        /// Longest time from the start of a connection, or from the previous response, to the end of a request's headers.
        pub header_timeout: Duration = Duration::from_secs(10),
        /// Longest time in which a client reads nothing of a response.
        pub write_timeout: Duration = Duration::from_secs(30),
        /// Bytes per second that a client has to read of a response on average, once it has stalled for that time in sum.
        pub min_response_rate: u64 = 4 << 10,
        /// How long `/readyz` fails on shutdown before connections are refused.
        pub drain_notice: Duration = Duration::ZERO,
        /// Longest time that open requests may take once the server shuts down.
        pub drain: Duration = Duration::from_secs(20),
        /// Bounds on requests.
        pub limits: RequestLimits = RequestLimits::default(),
    }
}

impl HttpConfig {
    /// Whether other machines could reach the address.
    #[must_use]
    pub fn is_exposed(&self) -> bool {
        !self.listen.ip().to_canonical().is_loopback()
    }

    /// Checks that the address may be served by a service that has keys, or has none.
    ///
    /// # Errors
    /// [`ExposureError`] for an address that other machines can reach while no key is required.
    pub fn check_exposure(&self, has_keys: bool) -> Result<(), ExposureError> {
        if !self.is_exposed() {
            return Ok(());
        }
        if self.limits.access.without_keys {
            return Err(ExposureError::WithoutKeys(self.listen));
        }
        if !has_keys {
            return Err(ExposureError::NoKeys(self.listen));
        }
        Ok(())
    }
}

/// An address that must not be served without keys.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum ExposureError {
    /// There are none.
    #[error(
        "{0} can be reached from other machines, and there are no API keys to tell who may: make one in the service's \
         data folder with 'tcgs keys create --data DIR --name NAME', or listen on a loopback address such as 127.0.0.1:8080"
    )]
    NoKeys(SocketAddr),
    /// They are switched off.
    #[error(
        "{0} can be reached from other machines, so keys must be required: omit --without-keys, or listen on 127.0.0.1"
    )]
    WithoutKeys(SocketAddr),
}

with_defaults! {
    /// Authentication and rate limits.
    #[derive(Debug, Clone)]
    pub struct AccessRules {
        /// Require no key even if there are some.
        pub without_keys: bool = false,
        /// Requests per minute of a key without a limit of its own; `None` for no limit.
        pub requests_per_minute: Option<NonZeroU32> = None,
        /// Requests per minute without a valid key from one address.
        pub failures_per_minute: NonZeroU32 = const { NonZeroU32::new(30).unwrap() },
        /// Proxies whose forwarding headers are trusted.
        pub trusted_proxies: TrustedProxies = TrustedProxies::default(),
        /// Origins whose pages may use the API, besides the service's own.
        pub allowed_origins: AllowedOrigins = AllowedOrigins::default(),
    }
}

with_defaults! {
    /// Bounds on what one request may ask for.
    #[derive(Debug, Clone)]
    pub struct RequestLimits {
        /// Authentication and rate limits.
        pub access: AccessRules = AccessRules::default(),
        /// Longest dataset archive, in bytes.
        pub upload_bytes: u64 = 4 << 30,
        /// Longest dataset archive of a resumable upload, in bytes.
        pub resumable_bytes: u64 = 64 << 30,
        /// How long an upload waits for its next part.
        pub upload_ttl: Duration = Duration::from_secs(24 * 3600),
        /// Archives received at a time.
        pub uploads: usize = 8,
        /// Datasets checked at a time: a slow one does not block all others, and all checks together stay below 256 MiB.
        pub checks: usize = 2,
        /// Longest time of a dataset's check, and of waiting for one: enough for some thousand photographs on a disk that has to seek for
        /// each.
        pub check_time: Duration = Duration::from_secs(120),
        /// Longest JSON body, in bytes.
        pub json_bytes: u64 = 1 << 20,
        /// Longest pause within a body.
        pub body_idle_timeout: Duration = Duration::from_secs(30),
        /// Longest time for a whole body.
        pub body_timeout: Duration = Duration::from_secs(3600),
        /// Bytes per second that a body has to bring on average, once it has lasted for the longest pause.
        pub min_body_rate: u64 = 1 << 10,
        /// Free bytes on the blobs' disk below which the server is not ready.
        pub min_free_space: u64 = 512 << 20,
        /// Longest side of a view, in pixels.
        pub view_side: u32 = 4096,
        /// Pixels of all views of a request together.
        pub view_pixels: u64 = 1 << 24,
        /// Views of a request.
        pub views: usize = 64,
        /// Views rendered at a time.
        pub renders: usize = 1,
        /// View requests that may wait for a permit.
        pub renders_waiting: usize = 32,
        /// View requests of one caller, rendering ones included.
        pub renders_per_caller: usize = 24,
        /// Streams of views at a time.
        pub streams: usize = 8,
        /// Streams of views of one caller.
        pub streams_per_caller: usize = 4,
        /// Frames of one round of a stream or animation.
        pub frames: u32 = 720,
        /// Pixels of all frames of an animation together.
        pub animation_pixels: u64 = 1 << 26,
        /// Size of the cache of encoded views, in bytes.
        pub view_cache_bytes: u64 = 64 << 20,
        /// Bytes of whole pictures and animations above a mebibyte that are sent at a time.
        pub held_bytes: u64 = 256 << 20,
        /// Scenes that are exported at a time.
        pub exports: usize = 1,
        /// Scenes that may wait to be exported.
        pub exports_waiting: usize = 8,
        /// How often the database is polled for changes of jobs while a request waits for one.
        pub watch_interval: Duration = Duration::from_millis(250),
        /// How often queued jobs are checked for passed deadlines.
        pub deadline_check_interval: Duration = Duration::from_secs(1),
        /// Requests that may wait for a job at a time; further ones are answered at once.
        pub waits: usize = 128,
        /// Streams of events at a time.
        pub event_streams: usize = 256,
        /// Streams of events of one key at a time.
        pub event_streams_per_key: usize = 128,
        /// Longest silence on a stream of events.
        pub keep_alive: Duration = Duration::from_secs(15),
        /// How often the key of an open event stream is checked for revocation.
        pub key_recheck_interval: Duration = Duration::from_secs(2),
        /// How long a browser's session lasts; it ends earlier with its key.
        pub session_ttl: Duration = Duration::from_secs(30 * 24 * 3600),
        /// Webhook endpoints of one key.
        pub webhook_endpoints: u32 = 10,
        /// Where webhook endpoints may be.
        pub webhook_targets: OutboundPolicy = OutboundPolicy::default(),
    }
}

/// Views that a replica leaves to viewers at a time. Each viewer renders one at a time by itself, so here it is only bounded how many
/// threads wait and how many pictures of 64 MiB are in memory. It is more than one caller may have, so that requests of one caller for
/// the scenes of a viewer that hangs leave room for others.
const REMOTE_RENDERS: usize = 32;

/// Exports that a replica leaves to viewers at a time. Each is whole in memory when it comes.
const REMOTE_EXPORTS: usize = 4;

impl RequestLimits {
    /// The same limits for a replica that leaves views and exports to viewers.
    #[must_use]
    pub fn for_remote_views(self) -> Self {
        Self { renders: REMOTE_RENDERS, exports: REMOTE_EXPORTS, ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn with_remote_views_one_caller_cannot_have_all_renders() {
        let limits = RequestLimits::default().for_remote_views();
        assert!(limits.renders > limits.renders_per_caller);
    }

    #[test]
    fn only_loopback_is_served_without_keys() {
        let on = |listen: &str| HttpConfig {
            listen: listen.parse().expect("an address"),
            ..HttpConfig::default()
        };
        let open = |listen: &str| {
            let access = AccessRules { without_keys: true, ..AccessRules::default() };
            HttpConfig { limits: RequestLimits { access, ..RequestLimits::default() }, ..on(listen) }
        };
        for listen in ["127.0.0.1:8080", "127.9.9.9:1", "[::1]:8080", "[::ffff:127.0.0.1]:80"] {
            for has_keys in [false, true] {
                assert_eq!(on(listen).check_exposure(has_keys), Ok(()), "{listen}");
                assert_eq!(open(listen).check_exposure(has_keys), Ok(()), "{listen}");
            }
        }
        for listen in ["0.0.0.0:8080", "[::]:8080", "192.168.1.4:8080", "[::ffff:10.0.0.1]:80"] {
            let config = on(listen);
            assert_eq!(config.check_exposure(false), Err(ExposureError::NoKeys(config.listen)), "{listen}");
            assert_eq!(config.check_exposure(true), Ok(()), "{listen}");
            let refused = Err(ExposureError::WithoutKeys(config.listen));
            assert_eq!(open(listen).check_exposure(true), refused, "{listen}");
        }
    }
}
