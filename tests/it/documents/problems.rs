//! Holds docs/PROBLEMS.md to the table of problem types: every type is listed once, with its status, and no other; and every type
//! of the table is in use.

use std::{collections::BTreeMap, fs, path::Path};

use tcgs::domain::ProblemType;

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
fn the_catalog_lists_every_problem_type_with_its_status_and_no_other() {
    let mut listed = listed();
    for kind in ProblemType::ALL {
        let stated = listed.remove(kind.name()).unwrap_or_else(|| panic!("{} is not listed", kind.name()));
        // Whatever status the HTTP library chooses.
        let status = if *kind == ProblemType::Refused { "4xx".to_owned() } else { kind.status().to_string() };
        assert!(
            stated.contains(&status),
            "{} is answered with {status}; the document says {stated}",
            kind.name()
        );
    }
    assert!(listed.is_empty(), "no such problem types: {:?}", listed.keys());
}

#[test]
fn types_have_names_in_kebab_case_and_titles() {
    let mut names: Vec<&str> = ProblemType::ALL.iter().map(|kind| kind.name()).collect();
    for kind in ProblemType::ALL {
        let is_word = |word: &str| !word.is_empty() && word.bytes().all(|byte| byte.is_ascii_lowercase());
        assert!(kind.name().split('-').all(is_word), "{}", kind.name());
        assert!(kind.title().starts_with(|c: char| c.is_ascii_uppercase()), "{}", kind.title());
    }
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), ProblemType::ALL.len(), "two types have one name");
}

fn code(folder: &Path, into: &mut String) {
    for entry in fs::read_dir(folder).expect("src is readable") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            code(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path).expect("readable");
            into.push_str(text.split("#[cfg(test)]").next().unwrap_or_default());
        }
    }
}

#[test]
fn every_problem_type_is_in_use() {
    let mut text = String::new();
    for folder in ["src", "crates"] {
        code(&Path::new(env!("CARGO_MANIFEST_DIR")).join(folder), &mut text);
    }
    for kind in ProblemType::ALL {
        let used = format!("ProblemType::{kind:?}");
        let is_use =
            |(at, _): (usize, &str)| !text[at + used.len()..].starts_with(|c: char| c.is_alphanumeric());
        assert!(text.match_indices(&used).any(is_use), "nothing reports {}", kind.name());
    }
}
