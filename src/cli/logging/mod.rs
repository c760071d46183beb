//! Log lines on standard error, as text or as JSON, chosen by `RUST_LOG`. An error that is recorded as one
//! (`error = &error as &dyn Error`) is logged with all of its causes in both formats.

mod causes;

use std::{
    fmt,
    io::{self, IsTerminal},
};

use clap::ValueEnum;
use tracing_subscriber::{
    EnvFilter,
    fmt::{MakeWriter, format},
    util::SubscriberInitExt as _,
};

use causes::WithCauses;

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

/// The log level if `RUST_LOG` is not set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verbosity {
    Warn,
    Info,
}

/// Starts logging for the rest of the process.
pub(crate) fn start(format: Format, verbosity: Verbosity) {
    let default = match verbosity {
        // Where a run resumes, and what was done to its photographs, are of interest to its user.
        Verbosity::Warn => "warn,tcgs_engine::train::trainer=info,tcgs_engine::pipeline=info",
        // The GPU crates' own messages at this level are of no use to an operator.
        Verbosity::Info => "info,wgpu_core=warn,wgpu_hal=warn,naga=warn",
    };
    let wanted = std::env::var("RUST_LOG").ok().filter(|wanted| !wanted.trim().is_empty());
    subscriber(format, wanted.as_deref().unwrap_or(default), io::stderr).init();
}

/// What writes the lines that `filter` lets through.
fn subscriber<W>(format: Format, filter: &str, writer: W) -> Box<dyn tracing::Subscriber + Send + Sync>
where
    W: for<'a> MakeWriter<'a> + Send + Sync + 'static,
{
    let builder = tracing_subscriber::fmt()
        .with_env_filter(EnvFilter::new(filter))
        .with_writer(writer)
        // It would panic where standard error is closed, in whatever task logs.
        .log_internal_errors(false);
    match format {
        Format::Text => Box::new(builder.with_ansi(io::stderr().is_terminal()).finish()),
        Format::Json => {
            let lines = WithCauses(format::format().json().flatten_event(true));
            Box::new(builder.json().event_format(lines).finish())
        }
    }
}
