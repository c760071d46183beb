//! Log lines on standard error, as text or as JSON, chosen by `RUST_LOG`.

use std::{
    fmt,
    io::{self, IsTerminal},
};

use clap::ValueEnum;
use tracing_subscriber::EnvFilter;

/// How a log line is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// For people.
    Text,
    /// One JSON object a line, for machines.
    Json,
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Format::Text => "text",
            Format::Json => "json",
        })
    }
}

/// What is logged where `RUST_LOG` does not say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verbosity {
    Warn,
    Info,
}

/// Starts logging for the rest of the process.
pub(crate) fn start(format: Format, verbosity: Verbosity) {
    let default = match verbosity {
        // Whoever waits for a training run is told what it takes.
        Verbosity::Warn => "warn,tcgs::train::trainer=info",
        // The GPU crates' own chatter at this level tells an operator nothing.
        Verbosity::Info => "info,wgpu_core=warn,wgpu_hal=warn,naga=warn",
    };
    let filter = match std::env::var("RUST_LOG") {
        Ok(wanted) if !wanted.trim().is_empty() => EnvFilter::new(wanted),
        _ => EnvFilter::new(default),
    };
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(io::stderr);
    match format {
        Format::Text => builder.with_ansi(io::stderr().is_terminal()).init(),
        Format::Json => builder.json().flatten_event(true).init(),
    }
}
