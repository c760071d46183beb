//! `tcgs serve`: the HTTP service with its own worker process.

use std::{net::SocketAddr, num::NonZeroU32, path::PathBuf};

use tcgs::{
    domain::{Bytes, DEFAULT_MAX_PRIORITY, KeyLimits, MAX_PRIORITY, OutboundPolicy},
    http::{ProxyNetwork, TrustedProxies, config::AccessRules},
};

use super::{
    Failure, Report,
    adapter::AdapterFlag,
    config::ConfigFlags,
    limits::LimitFlags,
    logging::Format,
    lpips::LpipsFlag,
    memory::MemoryFlags,
    priority::NiceFlag,
    storage::StorageFlags,
    wiring::{self, ServeOptions},
};

/// Arguments of `tcgs serve`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    pub(crate) config: ConfigFlags,

    /// Address to listen on; without API keys only a loopback address is served
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8080", env = "TCGS_LISTEN")]
    listen: SocketAddr,

    /// Serve /metrics at this address instead, where no key is asked for
    #[arg(long, value_name = "ADDR", env = "TCGS_METRICS_LISTEN")]
    metrics_listen: Option<SocketAddr>,

    /// Ask for no key even if there are some; on a loopback address only
    #[arg(long, env = "TCGS_WITHOUT_KEYS")]
    without_keys: bool,

    /// Requests in a minute of a key that has no rate of its own; not bounded if absent
    #[arg(long, value_name = "N", env = "TCGS_REQUESTS_PER_MINUTE")]
    requests_per_minute: Option<NonZeroU32>,

    /// Requests in a minute that may come from one address without a valid key
    #[arg(long, value_name = "N", default_value = "30", env = "TCGS_FAILURES_PER_MINUTE")]
    failures_per_minute: NonZeroU32,

    /// Networks of proxies, separated by commas, that are believed where a request comes from (X-Forwarded-For, Forwarded)
    #[arg(long, value_name = "CIDR", value_delimiter = ',', env = "TCGS_TRUSTED_PROXIES")]
    trusted_proxies: Vec<ProxyNetwork>,

    /// Storage that the scenes, uploads and jobs of such a key may take; not bounded if absent
    #[arg(long, value_name = "BYTES", env = "TCGS_MAX_BYTES")]
    max_bytes: Option<Bytes>,

    /// Jobs that such a key may have queued or running at a time; not bounded if absent
    #[arg(long, value_name = "N", env = "TCGS_MAX_ACTIVE_JOBS")]
    max_active_jobs: Option<u32>,

    /// Highest priority that the jobs of such a key may have
    #[arg(
        long,
        value_name = "N",
        default_value_t = DEFAULT_MAX_PRIORITY,
        allow_negative_numbers = true,
        value_parser = clap::value_parser!(i32).range(-i64::from(MAX_PRIORITY)..=i64::from(MAX_PRIORITY)),
        env = "TCGS_MAX_PRIORITY"
    )]
    max_priority: i32,

    #[command(flatten)]
    storage: StorageFlags,

    #[command(flatten)]
    adapter: AdapterFlag,

    #[command(flatten)]
    memory: MemoryFlags,

    /// Memory on the adapter that views of finished scenes may take, beside what each job may; a scene that needs more is not
    /// shown
    #[arg(long, value_name = "BYTES", default_value = "2GiB", env = "TCGS_VIEW_MEMORY")]
    view_memory: Bytes,

    #[command(flatten)]
    lpips: LpipsFlag,

    /// Let webhooks be sent to this machine itself, also without TLS; for trying them out
    #[arg(long, env = "TCGS_WEBHOOKS_ALLOW_LOOPBACK")]
    webhooks_allow_loopback: bool,

    /// PEM file of authorities whose certificates endpoints of webhooks may show, besides the system's
    #[arg(long, value_name = "FILE", env = "TCGS_WEBHOOKS_CA")]
    webhooks_ca: Option<PathBuf>,

    /// Worker processes to start; 0 if workers run elsewhere
    #[arg(long, value_name = "N", default_value_t = 1, env = "TCGS_WORKERS")]
    workers: u16,

    #[command(flatten)]
    nice: NiceFlag,

    #[command(flatten)]
    limits: LimitFlags,
}

/// Serves until a signal comes.
pub(crate) fn run(args: Args, log_format: Format) -> Result<Report, Failure> {
    let data = args.storage.folder()?;
    wiring::serve(ServeOptions {
        http: args.limits.config(
            args.listen,
            args.metrics_listen,
            AccessRules {
                without_keys: args.without_keys,
                requests_per_minute: args.requests_per_minute,
                failures_per_minute: args.failures_per_minute,
                trusted_proxies: TrustedProxies(args.trusted_proxies),
            },
        ),
        limits: KeyLimits {
            max_bytes: args.max_bytes.map(|bytes| bytes.0),
            max_active_jobs: args.max_active_jobs,
            requests_per_minute: args.requests_per_minute,
            max_priority: Some(args.max_priority),
        },
        data,
        adapter: args.adapter.adapter,
        lpips: args.lpips.lpips,
        workers: args.workers,
        worker_nice: args.nice.value()?,
        memory: args.memory.limits(args.workers),
        view_memory: args.view_memory.0,
        webhook_targets: OutboundPolicy { allow_loopback: args.webhooks_allow_loopback },
        webhook_roots: args.webhooks_ca,
        log_format,
    })?;
    Ok(Report::default())
}
