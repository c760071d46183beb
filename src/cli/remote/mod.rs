//! The commands for a service: `submit`, `watch`, `fetch`, `view`, `jobs`, `cancel`, `retry`, `delete`.
//!
//! The key comes from the environment or a file and is never shown. A problem response fails the command with the same exit status as
//! the local error would. Interrupted transfers are resumed a limited number of times.

pub(super) mod actions;
mod archive;
mod bytes_bar;
mod connection;
pub(super) mod fetch;
mod follow;
mod job;
pub(super) mod jobs;
mod sse;
pub(super) mod submit;
mod upload;
pub(super) mod view;
pub(super) mod watch;

use std::{
    borrow::Cow,
    env::{self, VarError},
    future::Future,
    path::PathBuf,
};

use tcgs::domain::{Problem, ProblemType};

use super::{CliError, files};
use connection::Connection;
pub(super) use job::JobArgs;

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

    /// Environment variable with the API key, if the service requires one [default: TCGS_API_KEY]
    #[arg(long, value_name = "NAME")]
    key_env: Option<String>,

    /// File that holds the API key, instead of the environment
    #[arg(long, value_name = "FILE")]
    key_file: Option<PathBuf>,
}

impl ServerFlags {
    /// A connection that sends the key, if there is one.
    fn connect(&self) -> Result<Connection, CliError> {
        let key = self.key()?;
        let key = key.as_deref().map(str::trim).filter(|key| !key.is_empty());
        Connection::new(&self.server, key, self.key_source())
    }

    /// The key. A variable that a flag names has to be set; without a flag there may be no key.
    fn key(&self) -> Result<Option<String>, CliError> {
        match (&self.key_file, &self.key_env) {
            (Some(path), _) => {
                let text = String::from_utf8(files::read(path)?);
                let not_text = |_| CliError::Usage(format!("--key-file: {} is not text", path.display()));
                text.map(Some).map_err(not_text)
            }
            (None, Some(name)) => {
                // Not the error's own text, which would show the value.
                let error = match env::var(name) {
                    Ok(key) if !key.trim().is_empty() => return Ok(Some(key)),
                    Ok(_) => "is empty",
                    Err(VarError::NotPresent) => "is not set",
                    Err(VarError::NotUnicode(_)) => "is not text",
                };
                Err(CliError::Usage(format!("--key-env: the variable {name} {error}")))
            }
            (None, None) => Ok(env::var(DEFAULT_KEY_ENV).ok()),
        }
    }

    /// Where the key comes from, for messages.
    fn key_source(&self) -> String {
        match &self.key_file {
            Some(path) => format!("the file {}", path.display()),
            None => format!("the variable {}", self.key_env.as_deref().unwrap_or(DEFAULT_KEY_ENV)),
        }
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
        if let Some(name) = &self.key_env {
            repeat("--key-env", name);
        }
        if let Some(file) = &self.key_file {
            repeat("--key-file", &file.to_string_lossy());
        }
        line
    }

    /// The address of something at the service, for a browser.
    fn address(&self, path: &str) -> String {
        format!("{}{path}", self.server.trim_end_matches('/'))
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
    let runtime = runtime.map_err(|error| {
        Problem::new(ProblemType::ResourceExhausted, format!("no runtime: {error}")).with_status(503)
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
