//! The output of a command, as text or as JSON.

use std::{
    io::{self, Write},
    process::ExitCode,
};

use super::{CliError, notice::notice};

/// The outcome of a command in both forms.
#[derive(Debug, Default)]
pub(crate) struct Report {
    /// Text output; nothing is printed if it is empty.
    pub(crate) text: String,
    /// JSON output.
    pub(crate) json: serde_json::Value,
}

impl Report {
    /// A report of a command that has no `--json`.
    pub(crate) fn text(text: impl Into<String>) -> Self {
        Self { text: text.into(), json: serde_json::Value::Null }
    }

    /// A report with `value` as its JSON form.
    pub(crate) fn new(text: impl Into<String>, value: &impl serde::Serialize) -> Self {
        let json = serde_json::to_value(value).expect("reports have string keys and finite depth");
        Self { text: text.into(), json }
    }
}

/// Prints the outcome and gives the exit status.
pub(crate) fn conclude(outcome: Result<Report, CliError>, json: bool) -> ExitCode {
    let (printed, status) = match outcome {
        Ok(report) if json => (print(&format!("{:#}", report.json)), 0),
        Ok(report) => (print(&report.text), 0),
        Err(failure) => {
            notice(format_args!("tcgs: {failure}"));
            let printed = if let CliError::Reported { text, json: document, .. } = &failure {
                if json { print(&format!("{document:#}")) } else { print(text) }
            } else if json {
                print(&serde_json::to_string_pretty(&failure.problem()).expect("a problem is plain data"))
            } else {
                Ok(())
            };
            (printed, failure.exit_status())
        }
    };
    match printed {
        // A closed pipe (`tcgs inspect … | head`) is no error.
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            notice(format_args!("tcgs: standard output: {error}"));
            ExitCode::from(4)
        }
        _ => ExitCode::from(status),
    }
}

fn print(text: &str) -> io::Result<()> {
    if text.is_empty() {
        return Ok(());
    }
    let mut out = io::stdout().lock();
    out.write_all(text.trim_end().as_bytes())?;
    out.write_all(b"\n")?;
    out.flush()
}
