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

use std::{borrow::Cow, future::Future, path::PathBuf};

use tcgs::domain::{Problem, ProblemType};

use super::{CliError, files};
use connection::Connection;

/// Where the service is if neither a flag nor a variable says it.
const DEFAULT_SERVER: &str = "http://127.0.0.1:8080";

/// Variable with the API key if no flag names another.
const DEFAULT_KEY_ENV: &str = "TCGS_API_KEY";

/// The service and the API key.
#[derive(Debug, clap::Args)]
pub(crate) struct ServerFlags {
    /// Address of the service
    #[arg(long, value_name = "URL", default_value = DEFAULT_SERVER, env = "TCGS_SERVER")]
    server: String,

    /// Environment variable with the API key, if the service requires one
    #[arg(long, value_name = "NAME", default_value = DEFAULT_KEY_ENV)]
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

impl ServerFlags {
    /// A command of `tcgs` to print, for the same service with the same key.
    fn command_line(&self, command: &str) -> String {
        let mut line = format!("tcgs {command}");
        let mut repeat = |flag: &str, value: &str| line += &format!(" {flag} {}", quoted(value));
        if self.server != DEFAULT_SERVER {
            repeat("--server", &self.server);
        }
        if self.key_env != DEFAULT_KEY_ENV {
            repeat("--key-env", &self.key_env);
        }
        if let Some(file) = &self.key_file {
            repeat("--key-file", &file.to_string_lossy());
        }
        line
    }
}

/// An argument as a shell reads it.
fn quoted(text: &str) -> Cow<'_, str> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "/:._-@%+,=".contains(c);
    if !text.is_empty() && text.chars().all(is_plain) {
        return text.into();
    }
    format!("'{}'", text.replace('\'', r"'\''")).into()
}

/// Runs a command's requests.
fn run<T>(work: impl Future<Output = Result<T, CliError>>) -> Result<T, CliError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|fault| {
        Problem::new(ProblemType::ResourceExhausted, format!("no runtime: {fault}")).with_status(503)
    })?;
    runtime.block_on(work)
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        server: ServerFlags,
    }

    #[test]
    fn printed_commands_repeat_the_flags_that_are_not_the_default() {
        let printed = |flags: &[&str]| {
            let line = Line::try_parse_from([&["watch"], flags].concat()).expect("parses");
            line.server.command_line("fetch ID -o scene.tcgs")
        };
        assert_eq!(printed(&["--server", DEFAULT_SERVER]), "tcgs fetch ID -o scene.tcgs");
        assert_eq!(
            printed(&["--server", "https://a.example:8443/tcgs", "--key-env", "MY_KEY"]),
            "tcgs fetch ID -o scene.tcgs --server https://a.example:8443/tcgs --key-env MY_KEY"
        );
        assert_eq!(
            printed(&["--server", DEFAULT_SERVER, "--key-file", "it's mine/key"]),
            r"tcgs fetch ID -o scene.tcgs --key-file 'it'\''s mine/key'"
        );
    }
}
