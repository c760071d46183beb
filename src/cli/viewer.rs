//! `tcgs viewer`: renders views and exports for API replicas.

use std::net::SocketAddr;

use url::Url;

use super::{
    CliError, Report,
    adapter::AdapterFlag,
    config::ConfigFlags,
    listen::listen_address,
    storage::StorageFlags,
    view_memory::ViewMemoryFlag,
    wiring::{self, Advertised, ViewerOptions},
};

/// Arguments of `tcgs viewer`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    pub(crate) config: ConfigFlags,

    /// Address at which replicas of the API reach this process; only they are answered
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8090", env = "TCGS_VIEWER_LISTEN", value_parser = listen_address)]
    listen: SocketAddr,

    /// URL at which replicas reach this process, if it is not http:// and the address it listens on, or this machine's name if it listens on
    /// all addresses
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
    let host = match &args.advertise {
        Some(url) if !is_base(url) => {
            return Err(CliError::Usage(format!(
                "--advertise: '{url}' is no URL such as http://10.0.0.7:8090"
            )));
        }
        Some(_) => None,
        None => args.listen.ip().is_unspecified().then(host_name).transpose()?,
    };
    wiring::viewer(ViewerOptions {
        listen: args.listen,
        advertise: match (args.advertise, host) {
            (Some(url), _) => Advertised::Url(url),
            (None, Some(name)) => Advertised::Host(name),
            (None, None) => Advertised::Address,
        },
        storage: args.storage.storage()?,
        adapter: args.adapter.adapter,
        memory: args.memory.view_memory.0,
    })?;
    Ok(Report::default())
}

/// Whether paths can be added to a URL.
fn is_base(url: &Url) -> bool {
    matches!(url.scheme(), "http" | "https")
        && url.has_host()
        && url.query().is_none()
        && url.fragment().is_none()
}

/// The name of this machine, by which others reach it if it listens on all addresses.
#[cfg(unix)]
fn host_name() -> Result<String, CliError> {
    let name = rustix::system::uname().nodename().to_string_lossy().into_owned();
    if name.is_empty() { Err(no_name()) } else { Ok(name) }
}

#[cfg(not(unix))]
fn host_name() -> Result<String, CliError> {
    Err(no_name())
}

fn no_name() -> CliError {
    CliError::Usage(
        "--advertise: name the URL at which replicas reach this machine, which listens on all its addresses"
            .into(),
    )
}
