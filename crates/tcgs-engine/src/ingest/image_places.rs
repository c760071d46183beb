//! The folders of a dataset's images by the names of their files: where the photographs of a table are that are not in place.

use std::collections::{BTreeMap, BTreeSet};

use super::{images::is_image_name, masks::is_mask_folder, names::normalized, plan::folder_of, tree::Tree};
use crate::domain::dataset::IMAGE_EXTENSIONS;

/// In how many folders files of one name are looked at.
pub(super) const MAX_PLACES: usize = 256;

/// Folders of splits: photographs of one are never those of another.
const SPLITS: [&str; 3] = ["train", "test", "val"];

/// Folders with an image for each photograph that is none.
const OTHER_IMAGES: [&str; 5] = ["depth", "depths", "normal", "normals", "semantics"];

/// The folders of images by their names.
pub(super) struct Places<'a>(BTreeMap<String, Vec<&'a str>>);

impl<'a> Places<'a> {
    /// Those of images that may be photographs, `taken` ones aside.
    pub(super) fn of(tree: &'a Tree, taken: &BTreeSet<&str>) -> Self {
        let mut places: BTreeMap<String, Vec<&'a str>> = BTreeMap::new();
        let may_be = |folder: &str| {
            folder.split('/').all(|part| {
                !is_mask_folder(part) && !OTHER_IMAGES.contains(&part.to_ascii_lowercase().as_str())
            })
        };
        for file in tree.names().filter(|name| is_image_name(name) && !taken.contains(name)) {
            let folder = folder_of(file);
            if may_be(folder) {
                let name = file.rsplit('/').next().unwrap_or(file);
                places.entry(normalized(name).into_owned()).or_default().push(folder);
            }
        }
        Self(places)
    }

    /// The only folder that serves best for `names` of the folder `stated`.
    pub(super) fn folder_of(&self, stated: &str, names: &BTreeSet<&str>) -> Option<&'a str> {
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        for name in names {
            let lists = self.of_name(name);
            if lists.iter().flatten().map(|list| list.len()).sum::<usize>() <= MAX_PLACES {
                let folders: BTreeSet<&str> = lists.into_iter().flatten().flatten().copied().collect();
                folders.into_iter().for_each(|folder| *counts.entry(folder).or_default() += 1);
            }
        }
        let mut ranked: Vec<_> = counts
            .into_iter()
            .filter(|(folder, _)| !is_other_split(stated, folder))
            .map(|(folder, count)| ((common_end(stated, folder), count), folder))
            .collect();
        ranked.sort_unstable_by(|a, b| b.cmp(a));
        match ranked.as_slice() {
            [(first, _), (second, _), ..] if first == second => None,
            [(_, folder), ..] => Some(folder),
            [] => None,
        }
    }

    /// The folders with files of this name, with or without the extension of an image.
    fn of_name(&self, name: &str) -> [Option<&Vec<&'a str>>; 9] {
        let name = normalized(name);
        let mut of_name = [None; 9];
        of_name[0] = self.0.get(&*name);
        for (index, extension) in IMAGE_EXTENSIONS.iter().enumerate() {
            of_name[1 + 2 * index] = self.0.get(&format!("{name}.{extension}"));
            of_name[2 + 2 * index] = self.0.get(&format!("{name}.{}", extension.to_uppercase()));
        }
        of_name
    }
}

/// How many last parts of two folders agree.
fn common_end(a: &str, b: &str) -> usize {
    a.rsplit('/').zip(b.rsplit('/')).take_while(|(a, b)| a == b && !a.is_empty()).count()
}

fn is_other_split(stated: &str, folder: &str) -> bool {
    let split = |folder: &str| SPLITS.into_iter().find(|split| folder.rsplit('/').next() == Some(split));
    split(stated).zip(split(folder)).is_some_and(|(a, b)| a != b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ends_of_folders_are_compared_by_parts() {
        assert_eq!(common_end("/home/x/images", "images"), 1);
        assert_eq!(common_end("C:/set/images/left", "images/left"), 2);
        assert_eq!(common_end("my_images", "images"), 0);
        assert_eq!(common_end("", ""), 0);
        assert!(is_other_split("/home/x/test", "train") && !is_other_split("/home/x/images", "train"));
    }
}
