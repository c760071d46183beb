//! Errors of commands and their exit statuses.

use std::{io, path::Path};

use tcgs::domain::{OptionError, Problem, ProblemType};
use thiserror::Error;

/// Why a command failed.
#[derive(Debug, Clone, PartialEq, Error)]
pub(crate) enum CliError {
    /// Arguments that are invalid together.
    #[error("{0}")]
    Usage(String),
    /// A refused input or a failure, depending on the problem's status.
    #[error(transparent)]
    Problem(#[from] Problem),
    /// The command came to its end, and what it reports is a failure.
    #[error("{problem}")]
    Reported {
        /// What is wrong with it.
        problem: Box<Problem>,
        /// Printed on standard output, as the text of a success is.
        text: String,
        /// Printed instead with `--json`.
        json: serde_json::Value,
    },
    /// Stopped by a signal.
    #[error("stopped; {advice}")]
    Stopped {
        /// Exit status of a process that the signal ends.
        status: u8,
        /// How to go on.
        advice: String,
    },
}

impl CliError {
    /// An input file that cannot be read.
    pub(crate) fn unreadable(path: &Path, error: &io::Error) -> Self {
        Problem::new(ProblemType::UnreadableInput, error.to_string())
            .in_file(path.display().to_string())
            .into()
    }

    /// An output file that cannot be written.
    pub(crate) fn unwritable(path: &Path, error: &io::Error) -> Self {
        Problem::new(ProblemType::UnwritableOutput, error.to_string())
            .in_file(path.display().to_string())
            .into()
    }

    /// The exit status: 2 wrong usage, 3 the input was refused, 4 a resource was missing or spent, 130 and 143 stopped by a signal, 1
    /// anything else.
    pub(crate) fn exit_status(&self) -> u8 {
        match self {
            CliError::Usage(_) => 2,
            CliError::Problem(problem) => exit_status_of(problem),
            CliError::Reported { problem, .. } => exit_status_of(problem),
            CliError::Stopped { status, .. } => *status,
        }
    }

    /// The failure as a problem document, for `--json`.
    pub(crate) fn problem(&self) -> Problem {
        match self {
            CliError::Usage(detail) => Problem::new(ProblemType::Usage, detail.clone()),
            CliError::Problem(problem) => problem.clone(),
            CliError::Reported { problem, .. } => (**problem).clone(),
            CliError::Stopped { advice, .. } => {
                Problem::new(ProblemType::Stopped, format!("a signal ended the command; {advice}"))
            }
        }
    }
}

fn exit_status_of(problem: &Problem) -> u8 {
    match problem.status {
        // A service's quota is a resource like any other.
        429 | 503 | 507 => 4,
        400..=499 => 3,
        _ => 1,
    }
}

impl From<OptionError> for CliError {
    fn from(error: OptionError) -> Self {
        let flag = format!("--{}", error.option.replace('_', "-"));
        CliError::Usage(format!("{flag}: {}", error.error))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exit_statuses_tell_input_from_resource_from_fault() {
        for (status, expected) in
            [(400, 3), (413, 3), (422, 3), (500, 1), (501, 1), (429, 4), (503, 4), (507, 4)]
        {
            let failure = CliError::from(Problem::new(ProblemType::Refused, "x").with_status(status));
            assert_eq!(failure.exit_status(), expected, "{status}");
        }
        assert_eq!(CliError::Usage(String::new()).exit_status(), 2);
        assert_eq!(CliError::Stopped { status: 130, advice: String::new() }.exit_status(), 130);
    }

    #[test]
    fn option_faults_name_the_flag_as_it_is_typed() {
        let error = OptionError { option: "max_bytes", error: "too small".to_owned() };
        assert_eq!(CliError::from(error), CliError::Usage("--max-bytes: too small".to_owned()));
    }
}
