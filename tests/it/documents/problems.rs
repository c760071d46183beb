//! Holds docs/PROBLEMS.md to the code: every problem type is listed once, with its statuses, and no other.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::Path,
};

use reqwest::StatusCode;

fn rust_files(folder: &Path, into: &mut Vec<String>) {
    for entry in fs::read_dir(folder).expect("src is readable") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            rust_files(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path).expect("readable");
            let code = text.split("#[cfg(test)]").next().unwrap_or_default();
            // The macro of the metrics' names has the same shape: a name and what it means.
            if !path.ends_with("metrics/scrape.rs") {
                into.push(code.to_owned());
            }
        }
    }
}

/// The string literal that `text` begins with, and what follows it.
fn literal(text: &str) -> Option<(&str, &str)> {
    text.strip_prefix('"')?.split_once('"')
}

fn is_type(name: &str) -> bool {
    let words = name.split('-');
    words.clone().count() > 0
        && words
            .into_iter()
            .all(|word| !word.is_empty() && word.bytes().all(|byte| byte.is_ascii_lowercase()))
}

/// The status that the tokens before a type's name end in, if it is a literal or a constant.
fn status_before(text: &str) -> Option<u16> {
    let text = text.trim_end().strip_suffix(',')?;
    let from = text.rfind(|c: char| !c.is_ascii_alphanumeric() && c != '_').map_or(0, |at| at + 1);
    let token = &text[from..];
    token.parse().ok().filter(|status| (400..600).contains(status)).or_else(|| {
        (400..600).find(|status| {
            let reason = StatusCode::from_u16(*status).ok().and_then(|status| status.canonical_reason());
            reason.is_some_and(|reason| reason.to_ascii_uppercase().replace([' ', '-'], "_") == token)
        })
    })
}

/// Every type in the code, which is a kebab-case literal followed by a title that begins with a capital, with the statuses that
/// stand before it.
fn used() -> BTreeMap<String, BTreeSet<u16>> {
    let mut files = Vec::new();
    rust_files(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut files);
    let mut used: BTreeMap<String, BTreeSet<u16>> = BTreeMap::new();
    for code in &files {
        for (at, _) in code.match_indices('"') {
            let Some((name, rest)) = literal(&code[at..]).filter(|(name, _)| is_type(name)) else { continue };
            let Some(rest) = rest.strip_prefix(',').map(str::trim_start) else { continue };
            let has_title =
                literal(rest).is_some_and(|(title, _)| title.starts_with(|c: char| c.is_ascii_uppercase()));
            if has_title {
                used.entry(name.to_owned()).or_default().extend(status_before(&code[..at]));
            }
        }
    }
    // What the HTTP library answers by itself has HTTP's own words for a title.
    for name in ["not-found", "method-not-allowed", "refused"] {
        assert!(files.iter().any(|code| code.contains(&format!("\"{name}\""))), "{name} is used no more");
        used.entry(name.to_owned()).or_default();
    }
    used
}

/// The types and statuses of the document's tables.
fn listed() -> BTreeMap<String, String> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/PROBLEMS.md");
    let document = fs::read_to_string(path).expect("readable");
    let mut listed = BTreeMap::new();
    for line in document.lines().filter(|line| line.starts_with("| `")) {
        let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
        let [name, status, when, what] = cells[..] else { panic!("{line} has {} cells", cells.len()) };
        assert!(!when.is_empty() && !what.is_empty(), "{line}");
        let name = name.trim_matches('`').to_owned();
        assert_eq!(listed.insert(name, status.to_owned()), None, "{line} is there twice");
    }
    listed
}

#[test]
fn the_catalogue_lists_every_problem_type_and_no_other() {
    let (used, listed) = (used(), listed());
    let missing: Vec<_> = used.iter().filter(|(name, _)| !listed.contains_key(*name)).collect();
    assert!(missing.is_empty(), "docs/PROBLEMS.md does not list {missing:#?}");
    let unknown: Vec<_> = listed.keys().filter(|name| !used.contains_key(*name)).collect();
    assert!(unknown.is_empty(), "nothing in src uses {unknown:?}");
    assert!(used.len() > 90, "only {} types were found", used.len());
}

#[test]
fn the_catalogue_states_the_statuses_that_the_code_has() {
    let listed = listed();
    for (name, statuses) in used() {
        let stated = &listed[&name];
        for status in statuses {
            assert!(
                stated.contains(&status.to_string()),
                "{name} is answered with {status}; the table says {stated}"
            );
        }
    }
}
