//! Finds the folder of a tree that the dataset is in.
//!
//! It may lie at any depth and beside other files, such as a README or a database, as long as there is one. A dataset inside of another's
//! folder belongs to that one, so a folder of earlier steps changes nothing.

use std::{collections::BTreeSet, ops::Bound};

use super::{
    error::{IngestErrorKind, Result, shown},
    formats,
    images::is_image_name,
    transforms,
    tree::Tree,
};

/// How many datasets a refusal names.
const MAX_ROOTS_SHOWN: usize = 4;

/// The folder of the only dataset, with a slash at its end; empty for the top.
///
/// # Errors
/// [`IngestErrorKind::NoLayout`] or [`IngestErrorKind::SeveralDatasets`].
pub(super) fn find(tree: &Tree) -> Result<String> {
    let images: BTreeSet<&str> = tree.names().filter(|name| is_image_name(name)).collect();
    let mut roots: BTreeSet<&str> = tree.names().filter_map(|name| root_of(tree, &images, name)).collect();
    let inner: Vec<&str> = roots.iter().copied().filter(|root| is_inside(root, &roots)).collect();
    inner.iter().for_each(|root| _ = roots.remove(root));
    let mut found = roots.iter();
    match (found.next(), found.next()) {
        (None, _) => {
            let unread = tree.names().find_map(|name| Some((name, formats::by_name(name)?)));
            let unread = unread.map(|(name, format)| (format.name, format.remedy(name)));
            Err(IngestErrorKind::NoLayout { photographs: images.len(), unread })
        }
        (Some(root), None) => Ok((*root).to_owned()),
        (Some(_), Some(_)) => Err(IngestErrorKind::SeveralDatasets {
            count: roots.len(),
            first: roots.iter().take(MAX_ROOTS_SHOWN).map(|root| shown(root)).collect(),
        }),
    }
}

/// The root of the dataset that a file is a table of, if it is one.
fn root_of<'a>(tree: &Tree, images: &BTreeSet<&str>, name: &'a str) -> Option<&'a str> {
    let at = name.rfind('/').map_or(0, |slash| slash + 1);
    let (folder, file) = name.split_at(at);
    match file {
        transforms::TRAIN | transforms::TRANSFORMS => Some(folder),
        "cameras.bin" | "cameras.txt" => {
            let above = |folder: &'a str, name: &str| {
                let before = folder.strip_suffix('/')?.strip_suffix(name)?;
                (before.is_empty() || before.ends_with('/')).then_some(before)
            };
            let sparse = above(folder, "sparse").or_else(|| above(parent(folder)?, "sparse"));
            if let Some(root) = sparse {
                return Some(above(root, "colmap").unwrap_or(root));
            }
            let has_images = ["bin", "txt"].iter().any(|end| tree.has(&format!("{folder}images.{end}")));
            has_images.then(|| root_of_flat(images, folder))
        }
        _ => None,
    }
}

/// The root of tables in a folder without a usual name: the folder itself, or the one above if only that has photographs.
fn root_of_flat<'a>(images: &BTreeSet<&str>, folder: &'a str) -> &'a str {
    let has_photographs = |folder: &str| {
        images
            .range::<str, _>((Bound::Included(folder), Bound::Unbounded))
            .next()
            .is_some_and(|name| name.starts_with(folder))
    };
    match parent(folder) {
        Some(above) if !has_photographs(folder) && has_photographs(above) => above,
        _ => folder,
    }
}

/// The folder that a folder is in; `None` for the top.
fn parent(folder: &str) -> Option<&str> {
    let folder = folder.strip_suffix('/')?;
    Some(&folder[..folder.rfind('/').map_or(0, |slash| slash + 1)])
}

fn is_inside(root: &str, roots: &BTreeSet<&str>) -> bool {
    std::iter::successors(parent(root), |folder| parent(folder)).any(|folder| roots.contains(folder))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_have_parents_up_to_the_top() {
        let above: Vec<&str> = std::iter::successors(Some("a/b/c/"), |folder| parent(folder)).collect();
        assert_eq!(above, ["a/b/c/", "a/b/", "a/", ""]);
    }
}
