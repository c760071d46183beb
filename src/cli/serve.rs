//! `tcgs serve`: the HTTP service with its own worker process.

use std::{net::SocketAddr, num::NonZeroU32, path::PathBuf, time::Duration};

use tcgs::{
    domain::{Bytes, DEFAULT_MAX_PRIORITY, MAX_PRIORITY, OutboundPolicy, ProjectLimits},
    http::{AllowedOrigin, AllowedOrigins, ProxyNetwork, TrustedProxies, config::AccessRules},
};

use super::{
    CliError, Report,
    adapter::AdapterFlag,
    camera_search::CameraFlags,
    config::ConfigFlags,
    limits::LimitFlags,
    listen::listen_address,
    logging::Format,
    lpips::LpipsFlag,
    memory::MemoryFlags,
    priority::WorkerPriorityFlag,
    projects::MaxRunningFlag,
    storage::StorageFlags,
    view_memory::ViewMemoryFlag,
    wiring::{self, ServeOptions},
};

/// Arguments of `tcgs serve`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    pub(crate) config: ConfigFlags,

    /// Address to listen on; only a loopback address is served without API keys
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8080", env = "TCGS_LISTEN", value_parser = listen_address)]
    listen: SocketAddr,

    /// Serve /metrics at this address instead, without a key
    #[arg(long, value_name = "ADDR", env = "TCGS_METRICS_LISTEN", value_parser = listen_address)]
    metrics_listen: Option<SocketAddr>,

    #[command(flatten)]
    storage: StorageFlags,

    #[command(flatten)]
    access: AccessFlags,

    #[command(flatten)]
    quotas: QuotaFlags,

    #[command(flatten, next_help_heading = "Workers")]
    adapter: AdapterFlag,

    #[command(flatten, next_help_heading = "Workers")]
    memory: MemoryFlags,

    #[command(flatten, next_help_heading = "Workers")]
    lpips: LpipsFlag,

    #[command(flatten, next_help_heading = "Workers")]
    cameras: CameraFlags,

    /// Worker processes to start; 0 if workers run elsewhere
    #[arg(long, value_name = "N", default_value_t = 1, env = "TCGS_WORKERS", help_heading = "Workers")]
    workers: u16,

    #[command(flatten, next_help_heading = "Workers")]
    nice: WorkerPriorityFlag,

    #[command(flatten, next_help_heading = "Views and webhooks")]
    views: ViewMemoryFlag,

    /// Leave views and exports to `tcgs viewer` processes with the same database and blobs; this one needs no adapter then
    #[arg(long, env = "TCGS_REMOTE_VIEWS", help_heading = "Views and webhooks")]
    remote_views: bool,

    #[command(flatten)]
    webhooks: WebhookFlags,

    #[command(flatten)]
    limits: LimitFlags,

    /// Days after which an ended job is removed, with its files and events; jobs are kept if absent
    #[arg(
        long,
        value_name = "DAYS",
        value_parser = clap::value_parser!(u32).range(1..=36_500),
        env = "TCGS_KEEP_JOBS",
        help_heading = "Limits"
    )]
    keep_jobs: Option<u32>,
}

/// Who may send requests.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Access")]
struct AccessFlags {
    /// Require no key even if there are some; on a loopback address only
    #[arg(long, env = "TCGS_WITHOUT_KEYS")]
    without_keys: bool,

    /// Requests per minute from one address without a valid key
    #[arg(long, value_name = "N", default_value = "30", env = "TCGS_FAILURES_PER_MINUTE")]
    failures_per_minute: NonZeroU32,

    /// Networks of proxies whose X-Forwarded-For or Forwarded header names the client, separated by commas
    #[arg(long, value_name = "CIDR", value_delimiter = ',', env = "TCGS_TRUSTED_PROXIES")]
    trusted_proxies: Vec<ProxyNetwork>,

    /// Origins whose pages may use the API from a browser, separated by commas, such as https://app.example; none if absent
    #[arg(long, value_name = "ORIGIN", value_delimiter = ',', env = "TCGS_ALLOW_ORIGINS")]
    allow_origins: Vec<AllowedOrigin>,

    /// File of the first key, for administrators: taken from it, or created and written into it, if the service has no keys yet
    #[arg(long, value_name = "FILE", env = "TCGS_BOOTSTRAP_ADMIN_KEY_FILE")]
    bootstrap_admin_key_file: Option<PathBuf>,
}

/// The limits of projects and keys that have none of their own.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Defaults of projects and keys")]
struct QuotaFlags {
    /// Requests per minute of a key [default: unlimited]
    #[arg(long, value_name = "N", env = "TCGS_REQUESTS_PER_MINUTE")]
    requests_per_minute: Option<NonZeroU32>,

    /// Storage for a project's datasets, uploads and jobs [default: unlimited]
    #[arg(long, value_name = "BYTES", env = "TCGS_QUOTA_BYTES")]
    quota_bytes: Option<Bytes>,

    /// Jobs of a project queued or running at the same time [default: unlimited]
    #[arg(long, value_name = "N", env = "TCGS_MAX_ACTIVE_JOBS")]
    max_active_jobs: Option<u32>,

    #[command(flatten)]
    running: MaxRunningFlag,

    /// Highest priority of a project's jobs
    #[arg(
        long,
        value_name = "N",
        default_value_t = DEFAULT_MAX_PRIORITY,
        allow_negative_numbers = true,
        value_parser = clap::value_parser!(i32).range(-i64::from(MAX_PRIORITY)..=i64::from(MAX_PRIORITY)),
        env = "TCGS_MAX_PRIORITY"
    )]
    max_priority: i32,
}

impl QuotaFlags {
    fn limits(&self) -> ProjectLimits {
        ProjectLimits {
            quota_bytes: self.quota_bytes.map(|bytes| bytes.0),
            max_active_jobs: self.max_active_jobs,
            max_running_jobs: self.running.max_running_jobs,
            max_priority: Some(self.max_priority),
        }
    }
}

/// Where webhooks may go.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Views and webhooks")]
struct WebhookFlags {
    /// Allow webhooks to this machine, also without TLS; for tests
    #[arg(long, env = "TCGS_WEBHOOKS_ALLOW_LOOPBACK")]
    webhooks_allow_loopback: bool,

    /// PEM file of certificate authorities to trust for webhook endpoints, in addition to the system's
    #[arg(long, value_name = "FILE", env = "TCGS_WEBHOOKS_CA")]
    webhooks_ca: Option<PathBuf>,
}

/// Serves until a signal comes.
pub(crate) fn run(args: Args, log_format: Format) -> Result<Report, CliError> {
    let access = AccessRules {
        without_keys: args.access.without_keys,
        requests_per_minute: args.quotas.requests_per_minute,
        failures_per_minute: args.access.failures_per_minute,
        trusted_proxies: TrustedProxies(args.access.trusted_proxies),
        allowed_origins: AllowedOrigins(args.access.allow_origins),
    };
    let storage = args.storage.storage()?;
    wiring::serve(ServeOptions {
        http: args.limits.config(args.listen, args.metrics_listen, access),
        limits: args.quotas.limits(),
        storage,
        first_key_file: args.access.bootstrap_admin_key_file,
        adapter: args.adapter.adapter,
        lpips: args.lpips.lpips,
        cameras: args.cameras,
        workers: args.workers,
        worker_nice: args.nice.value()?,
        memory: args.memory.limits(args.workers),
        view_memory: args.views.view_memory.0,
        remote_views: args.remote_views,
        webhook_targets: OutboundPolicy { allow_loopback: args.webhooks.webhooks_allow_loopback },
        webhook_roots: args.webhooks.webhooks_ca,
        keep_jobs: args.keep_jobs.map(|days| Duration::from_secs(u64::from(days) * 24 * 3600)),
        log_format,
    })?;
    Ok(Report::default())
}
