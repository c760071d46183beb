//! The container image builds from part of the tree; these tests hold that the part is enough.

use std::{collections::BTreeSet, path::Path};

use crate::support::tree::{root, text};

/// What `.dockerignore` lets into the build.
fn let_in() -> BTreeSet<String> {
    text(".dockerignore").lines().filter_map(|line| line.strip_prefix('!')).map(str::to_owned).collect()
}

/// The files that the manifest names, or implies by the name of a benchmark.
fn targets() -> Vec<String> {
    let manifest = text("Cargo.toml");
    let mut section = "";
    let mut files = Vec::new();
    for line in manifest.lines() {
        let value =
            |key: &str| line.strip_prefix(key)?.trim_start_matches([' ', '=']).trim().strip_prefix('"');
        if line.starts_with('[') {
            section = line;
        } else if let Some(path) = value("path").or_else(|| value("readme")) {
            if section == "[[bench]]" {
                // The name implies a file only where no path is given.
                files.pop();
            }
            files.push(path.trim_end_matches('"').to_owned());
        } else if section == "[[bench]]"
            && let Some(name) = value("name")
        {
            files.push(format!("benches/{}.rs", name.trim_end_matches('"')));
        }
    }
    files
}

#[test]
fn the_image_s_build_has_every_file_that_cargo_asks_for() {
    let let_in = let_in();
    let targets = targets();
    assert!(targets.iter().any(|file| file.starts_with("benches/")), "{targets:?}");
    for file in
        targets.iter().map(String::as_str).chain(["Cargo.lock", "shaders", "migrations", "openapi.yaml"])
    {
        assert!(root().join(file).exists(), "{file} is not there");
        let covered = Path::new(file).ancestors().any(|part| let_in.contains(&*part.to_string_lossy()));
        assert!(covered, ".dockerignore keeps {file} out, and cargo refuses a manifest without it");
    }
}
