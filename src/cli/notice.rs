//! Lines on standard error for people. They never fail: a run of hours does not end because nobody can read what it says.

use std::{
    fmt::Display,
    io::{self, Write as _},
};

/// Writes a line to standard error, if that is possible.
pub(crate) fn notice(line: impl Display) {
    let _ = writeln!(io::stderr().lock(), "{line}");
}
