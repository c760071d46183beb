//! Environment variables `TCGS_...`: whose value was refused, and which nothing reads.

use std::{
    collections::BTreeSet,
    env,
    ffi::{OsStr, OsString},
};

use clap::{Arg, Command, error::ContextKind, error::ContextValue};
use tcgs::worker::WORKER_ID_VARIABLE;

/// The beginning of every variable of this program.
const PREFIX: &str = "TCGS_";

/// Variables that are read without a flag of their own.
const WITHOUT_FLAGS: [&str; 7] = [
    "TCGS_API_KEY",
    "TCGS_COLMAP",
    "TCGS_FAIL_AT",
    "TCGS_FFMPEG",
    "TCGS_POSES_PYTHON",
    "TCGS_SHARED",
    // From a service to its worker.
    WORKER_ID_VARIABLE,
];

/// The variable whose value an error is about: that of its flag, if the flag was not typed.
pub(super) fn refused(error: &clap::Error, command: &Command, arguments: &[OsString]) -> Option<String> {
    let ContextValue::String(shown) = error.get(ContextKind::InvalidArg)? else { return None };
    let flag = shown.split_whitespace().next()?;
    let is_typed = arguments
        .iter()
        .any(|argument| argument.to_str().is_some_and(|text| text.split('=').next() == Some(flag)));
    if is_typed {
        return None;
    }
    let long = flag.strip_prefix("--")?;
    let name = flags(command).into_iter().find(|argument| argument.get_long() == Some(long))?.get_env()?;
    env::var_os(name)?;
    name.to_str().map(str::to_owned)
}

/// The variables of the environment that begin like this program's and that nothing reads.
pub(super) fn unread(command: &Command) -> Vec<String> {
    unread_among(command, env::vars_os().map(|(name, _)| name))
}

fn unread_among(command: &Command, names: impl Iterator<Item = OsString>) -> Vec<String> {
    let mut known: BTreeSet<&OsStr> = WITHOUT_FLAGS.iter().map(OsStr::new).collect();
    known.extend(flags(command).into_iter().filter_map(Arg::get_env));
    let ours = |name: &OsString| name.to_str().is_some_and(|name| name.starts_with(PREFIX));
    let mut unread: Vec<String> = names
        .filter(|name| ours(name) && !known.contains(name.as_os_str()))
        .filter_map(|name| name.into_string().ok())
        .collect();
    unread.sort();
    unread
}

/// The flags of a command and of all commands below it.
fn flags(command: &Command) -> Vec<&Arg> {
    command.get_arguments().chain(command.get_subcommands().flat_map(flags)).collect()
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn variables_that_nothing_reads_are_found() {
        let command = crate::cli::Cli::command();
        let names = [
            WORKER_ID_VARIABLE,
            "TCGS_WORKERS",
            "TCGS_WORKRS",
            "TCGS_API_KEY",
            "TCGS_LOG_FORMAT",
            "PATH",
            "TCGS_listen",
        ];
        let unread = unread_among(&command, names.into_iter().map(OsString::from));
        assert_eq!(unread, ["TCGS_WORKRS", "TCGS_listen"]);
    }
}
