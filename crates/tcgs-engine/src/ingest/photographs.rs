//! Photographs of a folder that is no dataset yet.

use std::path::Path;

use super::{Limits, folder, images::is_image_name, names::is_os_metadata};
use crate::domain::Problem;

/// The names of the photographs below `folder`, hidden ones aside, in no order.
///
/// # Errors
/// 413 for a folder of more files than a dataset may have, 422 if it cannot be read.
pub fn photographs(folder: &Path) -> Result<Vec<String>, Problem> {
    let is_hidden = |name: &str| name.split('/').any(|part| part.starts_with('.'));
    let files = folder::list(folder, &Limits::default())?.files.into_iter().map(|(name, _)| name);
    Ok(files.filter(|name| is_image_name(name) && !is_os_metadata(name) && !is_hidden(name)).collect())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn photographs_of_all_folders_are_found_and_nothing_else_is() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["b.JPG", "a/c.png", "a/d.webp", "notes.txt", ".hidden/e.jpg", "__MACOSX/._b.JPG"] {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
            fs::write(path, b"").expect("a file");
        }
        let mut found = photographs(folder.path()).expect("readable");
        found.sort_unstable();
        assert_eq!(found, ["a/c.png", "a/d.webp", "b.JPG"]);
        assert!(photographs(&folder.path().join("missing")).is_err());
    }
}
