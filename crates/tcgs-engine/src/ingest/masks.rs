//! Refuses datasets with masks: ignoring them would train another scene than their owner expects.
//!
//! Masks are found by the names that capture programs and trainers give them: a folder of masks, a mask beside its photograph, or a
//! path in a transforms file. A photograph that a table lists is none, whatever its name.

use std::collections::BTreeSet;

use super::{
    error::{IngestError, IngestErrorKind},
    images::is_image_name,
    plan::folder_of,
    tree::Tree,
};

/// Words in the name of a folder of masks.
const FOLDER_WORDS: [&str; 10] = [
    "mask",
    "masks",
    "segmentation",
    "segmentations",
    "segmented",
    "seg",
    "silhouette",
    "silhouettes",
    "matte",
    "mattes",
];

/// Words in the name of a mask, or of a field that names one.
const MASK_WORDS: [&str; 2] = ["mask", "masks"];

/// Last words of a field that names files.
const PATH_WORDS: [&str; 14] = [
    "mask",
    "masks",
    "path",
    "paths",
    "file",
    "files",
    "filename",
    "filenames",
    "name",
    "names",
    "dir",
    "folder",
    "image",
    "images",
];

/// How many words may stand between a photograph's name and the word for a mask, as in `0001_sky_mask.png`.
const QUALIFIERS: usize = 2;

/// Refuses a tree with masks among the images that are not `listed`.
///
/// # Errors
/// [`IngestErrorKind::Masks`], at the first mask by name.
pub(super) fn refuse_masks(tree: &Tree, listed: &BTreeSet<&str>) -> Result<(), IngestError> {
    let photographs: BTreeSet<String> = listed
        .iter()
        .flat_map(|file| [name_of(file), stem_of(name_of(file))])
        .map(str::to_lowercase)
        .collect();
    for image in tree.names().filter(|name| is_image_name(name) && !listed.contains(name)) {
        let folder = folder_of(image);
        if folder.split('/').any(is_mask_folder) {
            return Err(IngestErrorKind::Masks { place: format!("in {folder}/") }.at(image));
        }
        let is_beside = || listed.iter().any(|file| folder_of(file) == folder);
        if is_mask_of(name_of(image), &photographs) && is_beside() {
            return Err(IngestErrorKind::Masks { place: "beside the photographs".to_owned() }.at(image));
        }
    }
    Ok(())
}

/// Whether a folder's name says that it has masks.
pub(super) fn is_mask_folder(folder: &str) -> bool {
    words(folder).any(|(_, word)| FOLDER_WORDS.contains(&word.to_lowercase().as_str()))
}

/// Whether a field of a transforms file names masks, such as `mask_path`, `dynamicMaskPath` or `masks`.
pub(super) fn is_mask_field(name: &str) -> bool {
    let words: Vec<String> = words(name).map(|(_, word)| word.to_lowercase()).collect();
    words.iter().any(|word| MASK_WORDS.contains(&word.as_str()))
        && words.last().is_some_and(|last| PATH_WORDS.contains(&last.as_str()))
}

/// Whether an image is named after one of `photographs`, which are names and stems in lower case, and called a mask: `a.jpg.mask.png`,
/// `a_mask.png`, `dynamic_mask_a.png`; or has that very name and another extension behind it, as COLMAP names masks.
fn is_mask_of(image: &str, photographs: &BTreeSet<String>) -> bool {
    let stem = stem_of(image);
    if is_image_name(stem) && photographs.contains(&stem.to_lowercase()) {
        return true;
    }
    let is_mask = |(_, word): &(usize, &str)| MASK_WORDS.contains(&word.to_lowercase().as_str());
    let found: Vec<_> = words(stem).collect();
    let (Some(first), Some(last)) = (found.iter().position(is_mask), found.iter().rposition(is_mask)) else {
        return false;
    };
    let is_photograph = |text: &str| photographs.contains(&text.trim_matches(is_separator).to_lowercase());
    let before = (0..=QUALIFIERS.min(first)).map(|qualifiers| &stem[..found[first - qualifiers].0]);
    let after = (last + 1..found.len()).take(1 + QUALIFIERS).map(|word| &stem[found[word].0..]);
    before.chain(after).any(is_photograph)
}

fn is_separator(c: char) -> bool {
    !c.is_alphanumeric()
}

/// The words of a name with where each begins: runs of letters or digits; a capital after a small letter begins another.
fn words(name: &str) -> impl Iterator<Item = (usize, &str)> {
    let kind = |c: char| match c {
        c if c.is_numeric() => 1,
        c if c.is_alphabetic() => 2,
        _ => 0,
    };
    let mut rest = name.char_indices().peekable();
    std::iter::from_fn(move || {
        let (start, first) = rest.find(|(_, c)| kind(*c) != 0)?;
        let (mut end, mut last) = (start + first.len_utf8(), first);
        while let Some((at, c)) =
            rest.next_if(|(_, c)| kind(*c) == kind(last) && !(last.is_lowercase() && c.is_uppercase()))
        {
            (end, last) = (at + c.len_utf8(), c);
        }
        Some((start, &name[start..end]))
    })
}

fn name_of(file: &str) -> &str {
    file.rsplit_once('/').map_or(file, |(_, name)| name)
}

fn stem_of(name: &str) -> &str {
    name.rsplit_once('.').map_or(name, |(stem, _)| stem)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_taken_apart_into_words() {
        let words = |name| words(name).map(|(_, word)| word).collect::<Vec<_>>();
        assert_eq!(words("dynamic_mask_0001"), ["dynamic", "mask", "0001"]);
        assert_eq!(words("skyMasks2.Größe"), ["sky", "Masks", "2", "Größe"]);
        assert!(words("..").is_empty() && words("").is_empty());
    }

    #[test]
    fn folders_of_masks_are_told_from_others() {
        for folder in [
            "masks",
            "mask",
            "Masks",
            "MASKS",
            "masks_4",
            "dynamic_masks",
            "image-mask",
            "segmentation",
            "Silhouettes",
        ] {
            assert!(is_mask_folder(folder), "{folder}");
        }
        for folder in ["images", "unmasked", "masked", "damask", "maskros", "images_4", "depth", "segway"] {
            assert!(!is_mask_folder(folder), "{folder}");
        }
    }

    #[test]
    fn masks_are_named_after_their_photographs() {
        let photographs = ["0001.jpg", "0001", "mask_28.jpg", "mask_28", "übung.png", "übung"];
        let photographs = photographs.map(str::to_owned).into();
        for image in [
            "0001.jpg.mask.png",
            "0001.mask.png",
            "0001_mask.png",
            "0001.jpg_mask.png",
            "0001-sky-mask.png",
            "mask_0001.png",
            "dynamic_mask_0001.png",
            "dynamic_mask_0001.jpg.png",
            "0001.jpg.png",
            "0001Mask.png",
            "Übung_mask.png",
        ] {
            assert!(is_mask_of(image, &photographs), "{image}");
        }
        for image in
            ["mask_29.jpg", "0002_mask.png", "0001.png", "0001_depth.png", "0001_masked.png", "mask.png"]
        {
            assert!(!is_mask_of(image, &photographs), "{image}");
        }
    }

    #[test]
    fn fields_that_name_masks_are_told_from_others() {
        for field in ["mask_path", "mask", "masks", "maskPath", "dynamic_mask_path", "mask_paths", "mask_dir"]
        {
            assert!(is_mask_field(field), "{field}");
        }
        for field in ["mask_color", "masked", "file_path", "unmask", "path", ""] {
            assert!(!is_mask_field(field), "{field}");
        }
    }
}
