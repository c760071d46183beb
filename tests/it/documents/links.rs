//! Links in the documents lead somewhere, and paths and functions that ARCHITECTURE.md names exist.

use std::path::{Path, PathBuf};

use crate::support::tree::{files_under, root, text};

fn pages() -> Vec<String> {
    let at_the_root =
        ["ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md", "FORMAT.md", "README.md"].map(str::to_owned);
    let mut pages = files_under("docs");
    pages.retain(|path| path.ends_with(".md"));
    pages.extend(at_the_root);
    pages
}

/// What stands between `](` and `)`.
fn links(text: &str) -> impl Iterator<Item = &str> {
    text.split("](").skip(1).filter_map(|rest| Some(rest.split_once(')')?.0))
}

/// The anchors of a page's headings, as GitHub makes them.
fn anchors(text: &str) -> Vec<String> {
    let headings = text.lines().filter(|line| line.starts_with('#'));
    headings
        .map(|line| {
            let title = line.trim_start_matches('#').trim().to_lowercase();
            let kept = title.chars().filter(|c| c.is_alphanumeric() || "- _".contains(*c));
            kept.map(|c| if c == ' ' { '-' } else { c }).collect()
        })
        .collect()
}

#[test]
fn links_lead_somewhere() {
    let mut broken = Vec::new();
    for page in pages() {
        let text_of_page = text(&page);
        let folder = Path::new(&page).parent().expect("a folder");
        for link in links(&text_of_page).filter(|link| !link.contains("://")) {
            let (path, anchor) =
                link.split_once('#').map_or((link, None), |(path, anchor)| (path, Some(anchor)));
            let target = if path.is_empty() { root().join(&page) } else { root().join(folder).join(path) };
            let has_anchor = |anchor: &str| {
                std::fs::read_to_string(&target)
                    .is_ok_and(|text| anchors(&text).iter().any(|found| found == anchor))
            };
            if !target.exists() || anchor.is_some_and(|anchor| !has_anchor(anchor)) {
                broken.push(format!("{page}: {link}"));
            }
        }
    }
    assert!(broken.is_empty(), "{broken:#?}");
}

#[test]
fn paths_in_the_architecture_exist() {
    let document = text("ARCHITECTURE.md");
    let spans = document.split('`').skip(1).step_by(2);
    let paths: Vec<&str> = spans
        .filter(|span| span.contains('/') && !span.starts_with('/') && !span.contains([' ', '{', '*']))
        .filter(|span| span.ends_with(['/']) || span.ends_with(".rs") || span.ends_with(".wgsl"))
        .collect();
    assert!(paths.len() > 20, "{paths:?}");
    let missing: Vec<&&str> = paths.iter().filter(|path| sources(path).is_empty()).collect();
    assert!(missing.is_empty(), "{missing:?}");
}

/// Files and folders that a path of ARCHITECTURE.md may mean.
fn sources(path: &str) -> Vec<PathBuf> {
    let crates = ["codec", "render", "engine", "lab"].map(|name| format!("crates/tcgs-{name}/src"));
    let folders = crates.iter().map(String::as_str).chain(["src", "."]);
    folders.map(|folder| root().join(folder).join(path)).filter(|path| path.exists()).collect()
}

/// Functions after a file's name and a colon, each with the file.
fn functions(document: &str) -> Vec<(&str, &str)> {
    let parts: Vec<&str> = document.split('`').collect();
    let mut found = Vec::new();
    for file in (1..parts.len()).step_by(2).filter(|at| parts[*at].ends_with(".rs")) {
        let mut at = file + 1;
        while at + 1 < parts.len() && parts[at] == if at == file + 1 { ": " } else { ", " } {
            found.push((parts[file], parts[at + 1]));
            at += 2;
        }
    }
    found
}

#[test]
fn functions_in_the_architecture_exist() {
    let document = text("ARCHITECTURE.md");
    let functions = functions(&document);
    assert!(functions.len() > 20, "{functions:?}");
    let has = |file: &str, function: &str| {
        let name = function.rsplit("::").next().unwrap_or(function);
        sources(file).iter().any(|path| {
            let text = std::fs::read_to_string(path).unwrap_or_default();
            ["(", "<"].iter().any(|end| text.contains(&format!("fn {name}{end}")))
        })
    };
    let missing: Vec<_> = functions.iter().filter(|(file, function)| !has(file, function)).collect();
    assert!(missing.is_empty(), "{missing:?}");
}
