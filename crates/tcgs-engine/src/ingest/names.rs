//! Which file names are accepted, and their normal form.
//!
//! The same rule applies to archive entries and to the paths in JSON and COLMAP tables, so an accepted name can be looked up in the tree as
//! it is and never points outside of it.

use std::borrow::Cow;

use unicode_normalization::{IsNormalized, UnicodeNormalization as _, is_nfc_quick};

use super::error::{IngestErrorKind, Result};

/// Longest accepted name in bytes, the usual `PATH_MAX`.
pub(super) const MAX_NAME_BYTES: usize = 4096;

/// `name` as a relative path with `/` between its parts and without a leading `./`.
///
/// # Errors
/// [`IngestErrorKind::UnsafeName`] for an empty or overlong name, an absolute path, a drive letter, a backslash, control
/// characters, and the parts `..`, `.` and the empty one.
pub(super) fn safe_name(name: &str) -> Result<&str> {
    let refuse = |why| Err(IngestErrorKind::UnsafeName(why));
    let mut name = name;
    while let Some(rest) = name.strip_prefix("./") {
        name = rest;
    }
    if name.is_empty() {
        return refuse("it is empty");
    }
    if name.len() > MAX_NAME_BYTES {
        return refuse("it is longer than 4096 bytes");
    }
    if name.chars().any(char::is_control) {
        return refuse("it has control characters");
    }
    if name.contains('\\') {
        return refuse("it has a backslash; use '/' between folders");
    }
    if name.starts_with('/') {
        return refuse("it is an absolute path; use one relative to the dataset");
    }
    let bytes = name.as_bytes();
    if bytes[0].is_ascii_alphabetic() && bytes.get(1) == Some(&b':') {
        return refuse("it starts with a drive letter; use a path relative to the dataset");
    }
    for part in name.split('/') {
        match part {
            "" => return refuse("it has an empty part"),
            "." | ".." => return refuse("it has a '.' or '..' part, which could leave the dataset"),
            _ => {}
        }
    }
    Ok(name)
}

/// A path with `/` between its parts, as written on any system. No other accepted name has a backslash in it.
pub(super) fn portable(path: &str) -> Cow<'_, str> {
    if path.contains('\\') { path.replace('\\', "/").into() } else { path.into() }
}

/// A name in Unicode's normal form C: macOS writes accents as characters of their own, other systems as part of the letter.
pub(super) fn normalized(name: &str) -> Cow<'_, str> {
    match is_nfc_quick(name.chars()) {
        IsNormalized::Yes => name.into(),
        _ => name.nfc().collect::<String>().into(),
    }
}

/// Whether a file is litter of an operating system and not part of any dataset.
pub(super) fn is_os_metadata(name: &str) -> bool {
    name.split('/').any(|part| {
        part == "__MACOSX"
            || part == ".DS_Store"
            || part.starts_with("._")
            || part.eq_ignore_ascii_case("Thumbs.db")
            || part.eq_ignore_ascii_case("desktop.ini")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_relative_plain_and_portable() {
        for (name, expected) in [
            ("images/0001.jpg", "images/0001.jpg"),
            ("./train/r_0", "train/r_0"),
            ("././a", "a"),
            ("..a/b..", "..a/b.."),
            ("фото 1.png", "фото 1.png"),
        ] {
            assert_eq!(safe_name(name).expect(name), expected);
        }
        let long = "x".repeat(5000);
        for name in [
            "",
            "./",
            "/etc/passwd",
            "../a",
            "a/../b",
            "a/..",
            "a//b",
            "a/./b",
            "a/",
            "a\\b",
            "C:/a",
            "c:",
            "a\0b",
            "a\nb",
            long.as_str(),
        ] {
            assert!(
                matches!(safe_name(name), Err(IngestErrorKind::UnsafeName(_))),
                "{name:?} must be refused"
            );
        }
    }

    #[test]
    fn names_of_other_systems_become_one_form() {
        assert_eq!(portable(r"images\sub\0.jpg"), "images/sub/0.jpg");
        assert!(matches!(portable("images/0.jpg"), Cow::Borrowed(_)));
        assert_eq!(normalized("U\u{308}bung e\u{301}.jpg"), "Übung é.jpg");
        assert!(matches!(normalized("Übung é.jpg"), Cow::Borrowed(_)));
    }

    #[test]
    fn litter_is_told_from_files() {
        for name in ["__MACOSX/fox/._a", ".DS_Store", "fox/.DS_Store", "images/._0001.jpg", "Thumbs.db"] {
            assert!(is_os_metadata(name), "{name}");
        }
        for name in ["images/0001.jpg", "_a", "DS_Store", "transforms.json"] {
            assert!(!is_os_metadata(name), "{name}");
        }
    }
}
