//! How masks are named: by capture programs, by trainers, and in transforms files.

use super::images::is_image_name;

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

/// Whether a part of a path is the name of a folder of masks.
pub(super) fn is_mask_folder(folder: &str) -> bool {
    words(folder).any(|(_, word)| FOLDER_WORDS.contains(&word.to_lowercase().as_str()))
}

/// Whether a field of a transforms file names masks, such as `mask_path`, `dynamicMaskPath` or `masks`.
pub(super) fn is_mask_field(name: &str) -> bool {
    let words: Vec<String> = words(name).map(|(_, word)| word.to_lowercase()).collect();
    words.iter().any(|word| MASK_WORDS.contains(&word.as_str()))
        && words.last().is_some_and(|last| PATH_WORDS.contains(&last.as_str()))
}

/// Whether a mask is named as instant-ngp names those of moving things, `dynamic_mask_a.png`, in which white is what is hidden.
pub(super) fn is_dynamic(file: &str) -> bool {
    file.split('/').any(|part| {
        let words: Vec<String> = words(part).map(|(_, word)| word.to_lowercase()).collect();
        words.windows(2).any(|pair| pair[0] == "dynamic" && MASK_WORDS.contains(&pair[1].as_str()))
    })
}

/// The names that the photograph of a mask may have, with or without an extension, in lower case, the most likely one first; of a mask
/// in a folder of masks, its own name is among them. So `a.jpg` is for `a.jpg.mask.png`, `a.jpg_mask.png` and, as COLMAP names masks,
/// `a.jpg.png`; and `a` is for `a_mask.png`, `a_sky_mask.png` and `dynamic_mask_a.png`.
pub(super) fn photographs_of(image: &str, in_folder: bool) -> Vec<String> {
    let stem = stem_of(image);
    let mut names = Vec::new();
    if in_folder {
        names.push(image.to_lowercase());
    }
    if in_folder || is_image_name(stem) {
        names.push(stem.to_lowercase());
    }
    let is_mask = |(_, word): &(usize, &str)| MASK_WORDS.contains(&word.to_lowercase().as_str());
    let found: Vec<_> = words(stem).collect();
    let (Some(first), Some(last)) = (found.iter().position(is_mask), found.iter().rposition(is_mask)) else {
        return names;
    };
    let before = (0..=QUALIFIERS.min(first)).map(|qualifiers| &stem[..found[first - qualifiers].0]);
    let after = (last + 1..found.len()).take(1 + QUALIFIERS).map(|word| &stem[found[word].0..]);
    let trimmed = before.chain(after).map(|text| text.trim_matches(is_separator).to_lowercase());
    names.extend(trimmed.filter(|text| !text.is_empty()));
    names
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

pub(super) fn name_of(file: &str) -> &str {
    file.rsplit_once('/').map_or(file, |(_, name)| name)
}

pub(super) fn stem_of(name: &str) -> &str {
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
        let is_mask_of =
            |image| photographs_of(image, false).iter().any(|name| photographs.contains(&name.as_str()));
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
            assert!(is_mask_of(image), "{image}");
        }
        for image in
            ["mask_29.jpg", "0002_mask.png", "0001.png", "0001_depth.png", "0001_masked.png", "mask.png"]
        {
            assert!(!is_mask_of(image), "{image}");
        }
    }

    #[test]
    fn masks_in_a_folder_may_have_the_names_of_their_photographs() {
        assert_eq!(photographs_of("0001.PNG", true), ["0001.png", "0001"]);
        assert_eq!(photographs_of("0001.jpg.png", true), ["0001.jpg.png", "0001.jpg"]);
        assert!(photographs_of("0001_mask.png", true).contains(&"0001".to_owned()));
        assert!(photographs_of("mask.png", false).is_empty());
    }

    #[test]
    fn masks_of_moving_things_are_told_from_others() {
        for file in ["images/dynamic_mask_1.png", "dynamic_masks/1.png", "a/DynamicMask1.png"] {
            assert!(is_dynamic(file), "{file}");
        }
        for file in ["images/mask_1.png", "dynamic/1_mask.png", "masks/dynamic.png"] {
            assert!(!is_dynamic(file), "{file}");
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
