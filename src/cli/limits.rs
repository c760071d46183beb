//! The flags that limit connections, uploads and the time of requests.

use std::{net::SocketAddr, time::Duration};

use jiff::SignedDuration;
use tcgs::{
    domain::Bytes,
    http::{
        HttpConfig,
        config::{AccessRules, RequestLimits},
    },
};

/// A number of seconds, or numbers with units such as `500ms`, `90s`, `1h 30m`.
pub(super) fn duration(text: &str) -> Result<Duration, String> {
    let text = text.trim();
    let seconds = text.parse().map(Duration::from_secs).ok();
    let span = || text.parse::<SignedDuration>().ok().and_then(|span| Duration::try_from(span).ok());
    seconds.or_else(span).ok_or_else(|| format!("'{text}' is not a length of time such as 30s, 5m or 1h"))
}

/// A number of bytes that may be 0, which `Bytes` itself refuses.
fn bytes_or_none(text: &str) -> Result<Bytes, String> {
    if text.trim() == "0" { Ok(Bytes(0)) } else { text.parse() }
}

/// Limits of the HTTP service; `HttpConfig` documents each in full.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Limits")]
pub(crate) struct LimitFlags {
    /// Open connections; more wait in the system's queue
    #[arg(long, value_name = "N", default_value_t = 512, env = "TCGS_MAX_CONNECTIONS")]
    max_connections: usize,

    /// Open connections from one address, or one IPv6 /64; more are closed
    #[arg(long, value_name = "N", default_value_t = 128, env = "TCGS_MAX_CONNECTIONS_PER_ADDRESS")]
    max_connections_per_address: usize,

    /// Longest time in which a request's body brings nothing
    #[arg(long, value_name = "TIME", default_value = "30s", env = "TCGS_BODY_IDLE_TIMEOUT", value_parser = duration)]
    body_idle_timeout: Duration,

    /// Longest time for a request's body
    #[arg(long, value_name = "TIME", default_value = "1h", env = "TCGS_BODY_TIMEOUT", value_parser = duration)]
    body_timeout: Duration,

    /// Largest dataset archive in one request
    #[arg(long, value_name = "BYTES", default_value = "4GiB", env = "TCGS_MAX_UPLOAD")]
    max_upload: Bytes,

    /// Largest dataset archive of a resumable upload
    #[arg(long, value_name = "BYTES", default_value = "64GiB", env = "TCGS_MAX_RESUMABLE")]
    max_resumable: Bytes,

    /// Time after which a resumable upload without a new part is deleted
    #[arg(long, value_name = "TIME", default_value = "24h", env = "TCGS_UPLOAD_TTL", value_parser = duration)]
    upload_ttl: Duration,

    /// Datasets received, or made scenes of from finished uploads, at the same time, at most three quarters of them of one project
    #[arg(long, value_name = "N", default_value_t = 8, env = "TCGS_MAX_UPLOADS")]
    max_uploads: usize,

    /// Free disk space in the data folder below which the service is not ready and refuses datasets and jobs; 0 for no limit
    #[arg(long, value_name = "BYTES", default_value = "512MiB", env = "TCGS_MIN_FREE_SPACE", value_parser = bytes_or_none)]
    min_free_space: Bytes,

    /// Time between a stop signal, from which on /readyz fails, and the first refused connection, so that a proxy notices
    #[arg(long, value_name = "TIME", default_value = "0s", env = "TCGS_DRAIN_NOTICE", value_parser = duration)]
    drain_notice: Duration,

    /// Time that open requests have to finish after a stop signal
    #[arg(long, value_name = "TIME", default_value = "20s", env = "TCGS_DRAIN", value_parser = duration)]
    drain: Duration,
}

impl LimitFlags {
    /// The settings of a server at `listen`.
    pub(crate) fn config(
        &self,
        listen: SocketAddr,
        metrics_listen: Option<SocketAddr>,
        access: AccessRules,
    ) -> HttpConfig {
        HttpConfig {
            listen,
            metrics_listen,
            max_connections: self.max_connections,
            max_connections_per_address: self.max_connections_per_address,
            drain_notice: self.drain_notice,
            drain: self.drain,
            limits: RequestLimits {
                access,
                upload_bytes: self.max_upload.0,
                resumable_bytes: self.max_resumable.0,
                upload_ttl: self.upload_ttl,
                uploads: self.max_uploads,
                body_idle_timeout: self.body_idle_timeout,
                body_timeout: self.body_timeout,
                min_free_space: self.min_free_space.0,
                ..RequestLimits::default()
            },
            ..HttpConfig::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Limits {
        #[command(flatten)]
        limits: LimitFlags,
    }

    #[test]
    fn without_flags_the_limits_are_the_server_s_own() {
        let own = HttpConfig::default();
        let flags = Limits::parse_from(["limits"]).limits.config(own.listen, None, AccessRules::default());
        assert_eq!(format!("{flags:?}"), format!("{own:?}"));
    }

    #[test]
    fn each_flag_sets_its_own_limit() {
        let set = |flag: &str, value: &str| {
            let flags = Limits::parse_from(["limits", flag, value]).limits;
            flags.config(HttpConfig::default().listen, None, AccessRules::default()).limits
        };
        assert_eq!(set("--max-upload", "1KiB").upload_bytes, 1 << 10);
        assert_eq!(set("--max-resumable", "2KiB").resumable_bytes, 2 << 10);
        assert_eq!(set("--upload-ttl", "90m").upload_ttl, Duration::from_secs(5400));
        assert_eq!(set("--max-uploads", "3").uploads, 3);
        assert_eq!(set("--min-free-space", "8").min_free_space, 8);
        assert_eq!(set("--min-free-space", "0").min_free_space, 0);
    }

    #[test]
    fn spans_are_read_as_people_write_them() {
        for (text, milliseconds) in
            [("0s", 0), ("90", 90_000), (" 500ms ", 500), ("1h 30m", 5_400_000), ("2m", 120_000)]
        {
            assert_eq!(duration(text), Ok(Duration::from_millis(milliseconds)), "{text}");
        }
        for text in ["", "-1s", "soon", "1 fortnight", "-1"] {
            assert!(duration(text).is_err(), "{text}");
        }
    }
}
