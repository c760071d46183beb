//! What went wrong, in the shape of RFC 9457: the one form in which faults reach a user, over HTTP, in a failed
//! job and on the command line.

use std::{collections::BTreeMap, fmt};

use serde::{Deserialize, Serialize};

/// Prefix of every problem type.
pub const TYPE_PREFIX: &str = "urn:tcgs:problem:";

/// A problem document.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Problem {
    /// `urn:tcgs:problem:` and a kebab-case name.
    #[serde(rename = "type")]
    pub kind: String,
    /// The same for every problem of the type.
    pub title: String,
    /// HTTP status.
    pub status: u16,
    /// What was wrong here, where, and what to do.
    pub detail: String,
    /// The file of the upload that is at fault, if one is.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub file: Option<String>,
    /// Where a file was to be smaller than it can be: the fewest bytes that it can have.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub smallest_bytes: Option<u64>,
    /// Of a service that is not ready: each thing that was looked at, with `ok` or what is wrong with it.
    #[serde(skip_serializing_if = "BTreeMap::is_empty", default)]
    pub checks: BTreeMap<String, String>,
    /// Request id, if there was a request.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub instance: Option<String>,
}

impl Problem {
    /// A problem of the type `name` (kebab-case).
    #[must_use]
    pub fn new(status: u16, name: &str, title: &str, detail: impl Into<String>) -> Self {
        Self {
            kind: format!("{TYPE_PREFIX}{name}"),
            title: title.to_owned(),
            status,
            detail: detail.into(),
            file: None,
            smallest_bytes: None,
            checks: BTreeMap::new(),
            instance: None,
        }
    }

    /// The same problem, naming the file at fault.
    #[must_use]
    pub fn in_file(mut self, file: impl Into<String>) -> Self {
        self.file = Some(file.into());
        self
    }

    /// The same problem, telling the fewest bytes that a file can have.
    #[must_use]
    pub fn with_smallest_bytes(mut self, bytes: u64) -> Self {
        self.smallest_bytes = Some(bytes);
        self
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.file {
            Some(file) => write!(f, "{}: {file}: {}", self.title, self.detail),
            None => write!(f, "{}: {}", self.title, self.detail),
        }
    }
}

impl std::error::Error for Problem {}
