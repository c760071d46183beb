//! Names and phrases that were replaced do not come back.

use crate::support::tree::{files_under, text};

/// `old -> new`, one a line.
const TABLE: &str = "tests/it/documents/retired_words.txt";

/// What is searched. CHANGELOG.md names what was renamed, and a migration never changes.
const SEARCHED: [&str; 16] = [
    ".ci",
    "ARCHITECTURE.md",
    "CONTRIBUTING.md",
    "Cargo.toml",
    "FORMAT.md",
    "Makefile",
    "README.md",
    "benches",
    "crates",
    "docker",
    "docs",
    "examples",
    "openapi.yaml",
    "scripts",
    "shaders",
    "src",
];

/// Files of tests that are text of this project's own; others came from elsewhere or are outputs of earlier versions.
const TESTS: &str = "tests/it";

/// Old and new of each line of the table.
fn table(text: &str) -> Vec<(&str, &str)> {
    let lines = text.lines().filter(|line| !line.is_empty() && !line.starts_with('#'));
    lines.map(|line| line.split_once(" -> ").unwrap_or_else(|| panic!("not `old -> new`: {line}"))).collect()
}

/// The text on one line, without the marks that begin lines of comments, so that wrapped phrases are found too.
fn unwrapped(text: &str) -> String {
    let words = text.split_whitespace().filter(|word| !["//", "///", "//!", "#", "*"].contains(word));
    words.collect::<Vec<_>>().join(" ")
}

/// Whether `text` has `old` with no letter, digit or underscore right before or after it.
fn has_word(text: &str, old: &str) -> bool {
    let is_part = |c: char| c.is_alphanumeric() || c == '_';
    text.match_indices(old).any(|(at, _)| {
        let before = text[..at].chars().next_back();
        let after = text[at + old.len()..].chars().next();
        !before.is_some_and(is_part) && !after.is_some_and(is_part)
    })
}

#[test]
fn retired_words_do_not_come_back() {
    let table_text = text(TABLE);
    let table = table(&table_text);
    let mut found = Vec::new();
    for path in SEARCHED.into_iter().chain([TESTS]).flat_map(files_under) {
        // Pictures, databases and the like are not text.
        let Ok(text) = std::fs::read_to_string(crate::support::tree::root().join(&path)) else { continue };
        if path == TABLE {
            continue;
        }
        let text = unwrapped(&text);
        let again = table.iter().filter(|(old, _)| has_word(&text, old));
        found.extend(again.map(|(old, new)| format!("{path}: `{old}`, write `{new}`")));
    }
    assert!(found.is_empty(), "retired words:\n{}", found.join("\n"));
}

#[test]
fn the_table_is_sorted_and_names_each_word_once() {
    let table_text = text(TABLE);
    let table = table(&table_text);
    assert!(table.is_sorted_by(|(first, _), (second, _)| first < second), "sort {TABLE} by the old words");
    assert!(table.iter().all(|(old, new)| !has_word(new, old)), "a new name has the old one in it");
}

#[test]
fn words_are_found_whole_and_across_lines() {
    assert!(has_word("an Oldname.", "Oldname"));
    assert!(!has_word("OldnameSet oldname _Oldname", "Oldname"));
    assert!(has_word(&unwrapped("/// an old\n/// phrase"), "old phrase"));
    assert!(has_word("--old-flag 3s", "--old-flag"));
}
