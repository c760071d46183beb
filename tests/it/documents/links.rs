//! Links in the documents lead somewhere, and paths that ARCHITECTURE.md names exist.

use std::path::Path;

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
    let crates = ["codec", "render", "engine", "lab"].map(|name| format!("crates/tcgs-{name}/src"));
    let folders: Vec<&str> = crates.iter().map(String::as_str).chain(["src", "."]).collect();
    let exists = |path: &str| folders.iter().any(|folder| root().join(folder).join(path).exists());
    let missing: Vec<&&str> = paths.iter().filter(|path| !exists(path)).collect();
    assert!(missing.is_empty(), "{missing:?}");
}
