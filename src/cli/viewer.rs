//! `tcgs viewer`: renders views and exports for API replicas.

use std::net::SocketAddr;

use url::Url;

use super::{
    CliError, Report,
    adapter::AdapterFlag,
    config::ConfigFlags,
    storage::StorageFlags,
    view_memory::ViewMemoryFlag,
    wiring::{self, ViewerOptions},
};

/// Arguments of `tcgs viewer`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    pub(crate) config: ConfigFlags,

    /// Address at which replicas of the API reach this process; only they are answered
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8090", env = "TCGS_VIEWER_LISTEN")]
    listen: SocketAddr,

    /// URL at which replicas reach this process, if it is not http:// and the address it listens on
    #[arg(long, value_name = "URL", env = "TCGS_VIEWER_ADVERTISE")]
    advertise: Option<Url>,

    #[command(flatten)]
    storage: StorageFlags,

    #[command(flatten)]
    adapter: AdapterFlag,

    #[command(flatten)]
    memory: ViewMemoryFlag,
}

/// Renders until a signal comes.
pub(crate) fn run(args: Args) -> Result<Report, CliError> {
    if args.advertise.is_none() && args.listen.ip().is_unspecified() {
        return Err(CliError::Usage(format!(
            "--advertise: {} is no address that other machines can reach; name the URL at which they reach this one",
            args.listen
        )));
    }
    if let Some(url) = &args.advertise
        && !(matches!(url.scheme(), "http" | "https") && url.has_host() && url.query().is_none())
    {
        return Err(CliError::Usage(format!("--advertise: '{url}' is no URL such as http://10.0.0.7:8090")));
    }
    wiring::viewer(ViewerOptions {
        listen: args.listen,
        advertise: args.advertise,
        storage: args.storage.storage()?,
        adapter: args.adapter.adapter,
        memory: args.memory.view_memory.0,
    })?;
    Ok(Report::default())
}
