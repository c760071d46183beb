//! Photographs of a folder that is no dataset yet.

use std::{collections::BTreeSet, path::Path};

use super::{
    error::IngestErrorKind, folder, formats, images::is_image_name, limits::Limits, names::is_os_metadata,
};
use crate::domain::Problem;

/// The names of the photographs below `folder`, hidden ones aside, in no order.
///
/// # Errors
/// 413 for a folder of more files than a dataset may have; 422 if it cannot be read, or has photographs in a format that is not read.
pub fn photographs(folder: &Path) -> Result<Vec<String>, Problem> {
    let is_hidden = |name: &str| name.split('/').any(|part| part.starts_with('.'));
    let files = folder::list(folder, &Limits::default())?.files.into_iter().map(|(name, _)| name);
    let mut names: Vec<String> = files.filter(|name| !is_os_metadata(name) && !is_hidden(name)).collect();
    let stem = |name: &str| name.rsplit_once('.').map_or("", |(stem, _)| stem).to_owned();
    let read: BTreeSet<String> =
        names.iter().filter(|name| is_image_name(name)).map(|name| stem(name)).collect();
    for name in &names {
        let format = formats::by_name(name).filter(|format| format.is_of_cameras());
        // One that was converted may stay where it is.
        if let Some(format) = format.filter(|_| !read.contains(&stem(name))) {
            let remedy = format.remedy(name);
            return Err(IngestErrorKind::UnreadFormat { format: format.name, remedy }.at(name).into());
        }
    }
    names.retain(|name| is_image_name(name));
    Ok(names)
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
        let put = |name: &str| fs::write(folder.path().join(name), b"").expect("a file");
        put("b.HEIC");
        put("film.gif");
        assert_eq!(photographs(folder.path()).expect("converted beside").len(), 3);
        put("e.heic");
        put("a.tif");
        fs::remove_file(folder.path().join("b.HEIC")).expect("removed");
        let problem = photographs(folder.path()).expect_err("not read");
        assert!(problem.detail.contains("`magick mogrify -format "), "{problem}");
    }
}
