//! Sections of `docs/METHOD.md` that sources cite exist.

use std::collections::BTreeSet;

use crate::support::tree::{files_under, text};

const DOCUMENT: &str = "docs/METHOD.md";

/// The section numbers that follow the name of the document in a text, `§` before each.
fn cited(text: &str) -> impl Iterator<Item = &str> {
    text.split("METHOD.md ").skip(1).flat_map(|rest| {
        let end = rest.find(|c: char| !"§0123456789., to".contains(c)).unwrap_or(rest.len());
        let numbers = rest[..end].split('§').skip(1);
        numbers.map(|number| {
            let end = number.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(number.len());
            number[..end].trim_end_matches('.')
        })
    })
}

#[test]
fn every_cited_section_of_the_method_exists() {
    let document = text(DOCUMENT);
    let sections: BTreeSet<&str> = document
        .lines()
        .filter_map(|line| line.trim_start_matches('#').strip_prefix(' ').filter(|_| line.starts_with("##")))
        .filter_map(|title| title.split(' ').next())
        .collect();
    assert!(sections.contains("4.2"), "{sections:?}");
    let mut citations = 0;
    for path in ["crates", "src", "shaders"].into_iter().flat_map(files_under) {
        for section in cited(&text(&path)) {
            citations += 1;
            assert!(sections.contains(section), "{path}: {DOCUMENT} has no section {section}");
        }
    }
    assert!(citations > 50, "{citations} citations were found");
}

#[test]
fn citations_are_read_as_they_are_written() {
    let found = |text| cited(text).map(str::to_owned).collect::<Vec<_>>();
    assert_eq!(found("(METHOD.md §4.2)."), ["4.2"]);
    assert_eq!(found("METHOD.md §2.2, §2.3). And METHOD.md §5"), ["2.2", "2.3", "5"]);
    assert_eq!(found("METHOD.md §4.2 to §4.6: 0.01"), ["4.2", "4.6"]);
    assert!(found("docs/METHOD.md has it").is_empty());
}
