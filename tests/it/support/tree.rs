//! The files of this repository, which tests of documents read.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// The repository's root, from the tests of any crate.
pub fn root() -> &'static Path {
    let mut folders = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    folders.find(|folder| folder.join("ARCHITECTURE.md").exists()).expect("a crate of the repository")
}

/// The text of the file at this path below the root.
pub fn text(path: &str) -> String {
    fs::read_to_string(root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// Paths below the root of all files in a folder and its subfolders, sorted; the path itself if it is a file.
pub fn files_under(path: &str) -> Vec<String> {
    fn visit(path: PathBuf, found: &mut Vec<String>) {
        if path.is_dir() {
            let entries = fs::read_dir(&path).expect("a readable folder");
            entries.for_each(|entry| visit(entry.expect("an entry").path(), found));
        } else {
            let below = path.strip_prefix(root()).expect("a path below the root");
            found.push(below.to_str().expect("a name in UTF-8").to_owned());
        }
    }
    let mut found = Vec::new();
    visit(root().join(path), &mut found);
    found.sort();
    found
}
