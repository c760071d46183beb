//! The commands for a service: `submit`, `watch`, `fetch`, `view`.
//!
//! The key comes from the environment or a file and is never shown. A problem response fails the command with the same exit status as
//! the local error would. Interrupted transfers are resumed a limited number of times.

mod archive;
mod bytes_bar;
mod connection;
pub(super) mod fetch;
mod follow;
mod job;
mod sse;
pub(super) mod submit;
mod upload;
pub(super) mod view;
pub(super) mod watch;

use std::{future::Future, path::PathBuf};

use tcgs::domain::{Problem, ProblemType};

use super::{CliError, files};
use connection::Connection;

/// The service and the API key.
#[derive(Debug, clap::Args)]
pub(crate) struct ServerFlags {
    /// Address of the service
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8080", env = "TCGS_SERVER")]
    server: String,

    /// Environment variable with the API key, if the service requires one
    #[arg(long, value_name = "NAME", default_value = "TCGS_API_KEY")]
    key_env: String,

    /// File that holds the API key, instead of the environment
    #[arg(long, value_name = "FILE")]
    key_file: Option<PathBuf>,
}

impl ServerFlags {
    /// A connection that sends the key, if there is one.
    fn connect(&self) -> Result<Connection, CliError> {
        let key = match &self.key_file {
            Some(path) => {
                let text = String::from_utf8(files::read(path)?);
                Some(
                    text.map_err(|_| CliError::Usage(format!("--key-file: {} is not text", path.display())))?,
                )
            }
            None => std::env::var(&self.key_env).ok(),
        };
        Connection::new(&self.server, key.as_deref().map(str::trim).filter(|key| !key.is_empty()))
    }
}

/// Runs a command's requests.
fn run<T>(work: impl Future<Output = Result<T, CliError>>) -> Result<T, CliError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|fault| {
        Problem::new(ProblemType::ResourceExhausted, format!("no runtime: {fault}")).with_status(503)
    })?;
    runtime.block_on(work)
}
