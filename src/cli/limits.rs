//! The flags that bound what the HTTP service bears, and how patiently.

use std::{fmt, net::SocketAddr, str::FromStr, time::Duration};

use jiff::SignedDuration;
use tcgs::{
    domain::Bytes,
    http::{
        HttpConfig,
        config::{AccessRules, RequestLimits},
    },
};

/// A length of time as people write it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Span(pub(crate) Duration);

impl FromStr for Span {
    type Err = String;

    /// A number of seconds, or numbers with units such as `500ms`, `90s`, `1h 30m`.
    fn from_str(text: &str) -> Result<Self, String> {
        let fault = || format!("'{text}' is not a length of time such as 30s, 5m or 1h");
        if let Ok(seconds) = text.trim().parse::<u64>() {
            return Ok(Self(Duration::from_secs(seconds)));
        }
        let span: SignedDuration = text.trim().parse().map_err(|_| fault())?;
        Duration::try_from(span).map(Self).map_err(|_| fault())
    }
}

impl fmt::Display for Span {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.0)
    }
}

/// A number of bytes, or 0.
fn bytes_or_none(text: &str) -> Result<Bytes, String> {
    if text.trim() == "0" { Ok(Bytes(0)) } else { text.parse() }
}

/// The service's bounds; `HttpConfig` has what each means in full.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Limits")]
pub(crate) struct LimitFlags {
    /// Connections served at a time; more wait in the system's queue
    #[arg(long, value_name = "N", default_value_t = 512, env = "TCGS_MAX_CONNECTIONS")]
    max_connections: usize,

    /// Connections of one address, or one IPv6 /64, served at a time; more are closed
    #[arg(long, value_name = "N", default_value_t = 128, env = "TCGS_MAX_CONNECTIONS_PER_ADDRESS")]
    max_connections_per_address: usize,

    /// Longest time from a connection's begin, or from the previous answer, to the end of a request's headers
    #[arg(long, value_name = "TIME", default_value = "10s", env = "TCGS_HEADER_TIMEOUT")]
    header_timeout: Span,

    /// Longest time in which a client takes nothing of an answer
    #[arg(long, value_name = "TIME", default_value = "30s", env = "TCGS_WRITE_TIMEOUT")]
    write_timeout: Span,

    /// Bytes a second of an answer that a client has to take on average once --write-timeout has been waited for it
    #[arg(long, value_name = "BYTES", default_value = "4KiB", env = "TCGS_ANSWER_RATE")]
    min_response_rate: Bytes,

    /// Longest pause within a request's body
    #[arg(long, value_name = "TIME", default_value = "30s", env = "TCGS_BODY_PAUSE")]
    body_pause: Span,

    /// Longest time for a whole body
    #[arg(long, value_name = "TIME", default_value = "1h", env = "TCGS_BODY_TIMEOUT")]
    body_timeout: Span,

    /// Bytes a second that a body has to bring on average once --body-pause has passed
    #[arg(long, value_name = "BYTES", default_value = "1KiB", env = "TCGS_BODY_RATE")]
    min_body_rate: Bytes,

    /// Longest dataset archive
    #[arg(long, value_name = "BYTES", default_value = "4GiB", env = "TCGS_MAX_UPLOAD")]
    max_upload: Bytes,

    /// Longest dataset archive that comes in parts
    #[arg(long, value_name = "BYTES", default_value = "64GiB", env = "TCGS_MAX_RESUMABLE")]
    max_resumable: Bytes,

    /// How long an upload in parts waits for its next part
    #[arg(long, value_name = "TIME", default_value = "24h", env = "TCGS_UPLOAD_LIFE")]
    upload_ttl: Span,

    /// Datasets received at a time
    #[arg(long, value_name = "N", default_value_t = 8, env = "TCGS_MAX_UPLOADS")]
    max_uploads: usize,

    /// Requests for views that may wait for their turn
    #[arg(long, value_name = "N", default_value_t = 32, env = "TCGS_VIEW_QUEUE")]
    view_queue: usize,

    /// Streams of views at a time, half of which one key may have
    #[arg(long, value_name = "N", default_value_t = 8, env = "TCGS_VIEW_STREAMS")]
    view_streams: usize,

    /// Main memory for pictures that are kept for whoever asks again
    #[arg(long, value_name = "BYTES", default_value = "64MiB", env = "TCGS_VIEW_CACHE")]
    view_cache: Bytes,

    /// Free room on the data folder's disk below which the service is not ready and takes neither datasets nor jobs; 0 for
    /// no such bound
    #[arg(long, value_name = "BYTES", default_value = "512MiB", env = "TCGS_MIN_FREE_SPACE", value_parser = bytes_or_none)]
    min_free_space: Bytes,

    /// How long /readyz already fails on a stop before connections are refused, so that a proxy can look elsewhere
    #[arg(long, value_name = "TIME", default_value = "0s", env = "TCGS_DRAIN_NOTICE")]
    drain_notice: Span,

    /// Longest time that open requests may take once the service stops
    #[arg(long, value_name = "TIME", default_value = "20s", env = "TCGS_DRAIN")]
    drain: Span,
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
            header_timeout: self.header_timeout.0,
            write_timeout: self.write_timeout.0,
            min_response_rate: self.min_response_rate.0,
            drain_notice: self.drain_notice.0,
            drain: self.drain.0,
            limits: RequestLimits {
                access,
                upload_bytes: self.max_upload.0,
                resumable_bytes: self.max_resumable.0,
                upload_ttl: self.upload_ttl.0,
                uploads: self.max_uploads,
                body_idle_timeout: self.body_pause.0,
                body_timeout: self.body_timeout.0,
                min_body_rate: self.min_body_rate.0,
                min_free_space: self.min_free_space.0,
                renders_waiting: self.view_queue,
                streams: self.view_streams,
                streams_per_caller: self.view_streams.div_ceil(2),
                view_cache_bytes: self.view_cache.0,
                ..RequestLimits::default()
            },
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
        assert_eq!(set("--upload-life", "90m").upload_ttl, Duration::from_secs(5400));
        assert_eq!(set("--max-uploads", "3").uploads, 3);
        assert_eq!(set("--view-queue", "4").renders_waiting, 4);
        let streams = set("--view-streams", "5");
        assert_eq!((streams.streams, streams.streams_per_caller), (5, 3));
        assert_eq!(set("--view-cache", "6MiB").view_cache_bytes, 6 << 20);
        assert_eq!(set("--body-rate", "7").min_body_rate, 7);
        assert_eq!(set("--min-free-space", "8").min_free_space, 8);
        assert_eq!(set("--min-free-space", "0").min_free_space, 0);
    }

    #[test]
    fn spans_are_read_as_people_write_them() {
        for (text, milliseconds) in
            [("0s", 0), ("90", 90_000), (" 500ms ", 500), ("1h 30m", 5_400_000), ("2m", 120_000)]
        {
            assert_eq!(text.parse(), Ok(Span(Duration::from_millis(milliseconds))), "{text}");
        }
        for text in ["", "-1s", "soon", "1 fortnight", "-1"] {
            assert!(text.parse::<Span>().is_err(), "{text}");
        }
    }
}
