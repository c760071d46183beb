//! Names and labels that users give to their jobs.
//!
//! Both are bounded, and a [`Metadata`] exists only within its bounds, so that lists stay small and logs readable.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Most labels of a job.
pub const MAX_LABELS: usize = 16;

/// Longest key of a label, in characters.
pub const MAX_LABEL_KEY: usize = 64;

/// Longest value of a label, in characters.
pub const MAX_LABEL_VALUE: usize = 512;

/// Longest name of a job, key or project, in characters.
pub const MAX_NAME: usize = 100;

/// The trimmed name, if it has 1 to [`MAX_NAME`] characters and none of them is a control character.
#[must_use]
pub fn valid_name(name: &str) -> Option<&str> {
    let name = name.trim();
    let has_length = !name.is_empty() && name.chars().count() <= MAX_NAME;
    (has_length && !name.chars().any(char::is_control)).then_some(name)
}

/// Labels of a job: text by key, at most [`MAX_LABELS`].
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "BTreeMap<String, String>")]
pub struct Metadata(BTreeMap<String, String>);

/// Labels that cannot be stored.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum MetadataError {
    /// There are too many.
    #[error("{0} labels are more than {MAX_LABELS}")]
    TooMany(usize),
    /// A key has another length or other characters.
    #[error("a key has 1 to {MAX_LABEL_KEY} characters of A-Z, a-z, 0-9, '_', '-' and '.'")]
    Key,
    /// A value is too long or has control characters.
    #[error("the value of '{0}' is longer than {MAX_LABEL_VALUE} characters, or has control characters")]
    Value(String),
}

impl TryFrom<BTreeMap<String, String>> for Metadata {
    type Error = MetadataError;

    fn try_from(labels: BTreeMap<String, String>) -> Result<Self, MetadataError> {
        if labels.len() > MAX_LABELS {
            return Err(MetadataError::TooMany(labels.len()));
        }
        let is_key = |text: &str| {
            (1..=MAX_LABEL_KEY).contains(&text.len())
                && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'-' | b'.'))
        };
        for (key, value) in &labels {
            if !is_key(key) {
                return Err(MetadataError::Key);
            }
            if value.chars().count() > MAX_LABEL_VALUE || value.chars().any(char::is_control) {
                return Err(MetadataError::Value(key.clone()));
            }
        }
        Ok(Self(labels))
    }
}

impl Metadata {
    /// The labels, by key.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        self.0.iter().map(|(key, value)| (&**key, &**value))
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(pairs: &[(&str, &str)]) -> Result<Metadata, MetadataError> {
        let owned = pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned()));
        Metadata::try_from(owned.collect::<BTreeMap<_, _>>())
    }

    #[test]
    fn labels_within_the_bounds_are_kept_as_they_are() {
        let longest = (&*"k".repeat(MAX_LABEL_KEY), &*"é".repeat(MAX_LABEL_VALUE));
        let kept =
            labels(&[longest, ("site.no-1_A", ""), ("who", "Ada & Söhne")]).expect("within the bounds");
        assert_eq!(kept.iter().count(), 3);
        let json = serde_json::to_value(&kept).expect("JSON");
        assert_eq!(serde_json::from_value::<Metadata>(json).expect("read back"), kept);
        assert!(labels(&[]).expect("none").is_empty());
    }

    #[test]
    fn labels_beyond_the_bounds_are_refused() {
        let many: Vec<String> = (0..=MAX_LABELS).map(|number| number.to_string()).collect();
        let many: Vec<(&str, &str)> = many.iter().map(|key| (&**key, "")).collect();
        assert_eq!(labels(&many), Err(MetadataError::TooMany(MAX_LABELS + 1)));
        for key in ["", "a b", "é", "a\"b", &"k".repeat(MAX_LABEL_KEY + 1)] {
            assert_eq!(labels(&[(key, "")]), Err(MetadataError::Key), "{key}");
        }
        for value in ["a\nb", &"v".repeat(MAX_LABEL_VALUE + 1)] {
            assert_eq!(labels(&[("k", value)]), Err(MetadataError::Value("k".into())), "{value}");
        }
    }

    #[test]
    fn names_are_trimmed_and_bounded() {
        assert_eq!(valid_name("  a garden "), Some("a garden"));
        assert_eq!(valid_name(&"é".repeat(MAX_NAME)).map(|name| name.chars().count()), Some(MAX_NAME));
        for name in ["", "  ", "a\nb", &"n".repeat(MAX_NAME + 1)] {
            assert_eq!(valid_name(name), None, "{name:?}");
        }
    }
}
