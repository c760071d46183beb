//! Finds the image files that a table lists, where it says or else by their names.
//!
//! Tables are often written on another machine, in another folder or for another program. So the photographs of a folder of which the
//! dataset has none in place are looked for by name: all of them in one folder, whose last parts agree with the stated ones the longest,
//! and then the one that has the most of them. Where two folders serve alike, nothing is guessed. Nothing outside of the tree is opened.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    error::{IngestError, IngestErrorKind, MissingHint, Result, several, shown},
    formats,
    image_places::{MAX_PLACES, Places},
    images::is_image_name,
    names::{normalized, portable, safe_name},
    plan::folder_of,
    source::NameEncoding,
    tree::Tree,
};
use crate::domain::{
    ReadOptions,
    dataset::{IMAGE_EXTENSIONS, without_extension},
};

/// How many missing images a message names.
const MAX_MISSING_SHOWN: usize = 5;

/// What a table lists.
pub(super) struct ImageFiles<'a> {
    pub(super) tree: &'a Tree,
    /// The table.
    pub(super) listing: &'a str,
    /// Folders that its names are relative to, each "" or with a slash at its end, in the order of preference.
    pub(super) folders: &'a [&'a str],
    /// Files that other tables have taken, which are not found by their names.
    pub(super) taken: &'a BTreeSet<String>,
}

/// The image of a listed frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct FoundImage {
    /// Name of the frame.
    pub(super) name: String,
    /// The file in the tree.
    pub(super) file: String,
}

/// The images of a table, those found and those missing.
pub(super) struct ImageSearch {
    /// One for each listed name.
    pub(super) found: Vec<Option<FoundImage>>,
    /// Frames that are not called as the table calls them, by the normal form of the stated path.
    pub(super) aliases: BTreeMap<String, String>,
    listing: String,
    first_missing: Vec<String>,
    listed: usize,
    /// Stated paths of missing images, in their normal form.
    missing: Vec<String>,
    hint: Option<MissingHint>,
    /// The first stated path that was found elsewhere, and the file.
    moved: Option<(String, String)>,
}

/// A stated path: its folder as stated, and the name in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Stated<'a> {
    folder: &'a str,
    name: &'a str,
    /// Whether it can be a path in the dataset.
    is_relative: bool,
}

/// Takes a path of any machine apart.
///
/// # Errors
/// [`IngestErrorKind::UnsafeName`] for a path that names no file.
fn stated(path: &str) -> Result<Stated<'_>> {
    let refused = match safe_name(path) {
        Ok(path) => {
            let name = path.rsplit('/').next().unwrap_or(path);
            return Ok(Stated { folder: folder_of(path), name, is_relative: true });
        }
        Err(refused) => refused,
    };
    match path.rsplit_once('/') {
        Some((folder, name)) if safe_name(name).is_ok() && is_plain(path) => {
            Ok(Stated { folder, name, is_relative: false })
        }
        _ => Err(refused),
    }
}

fn is_plain(path: &str) -> bool {
    path.len() <= super::names::MAX_NAME_BYTES && !path.chars().any(char::is_control)
}

impl ImageFiles<'_> {
    /// The image of each of `paths`, which are in the order of the table; `place` says where in it one stands.
    ///
    /// # Errors
    /// [`IngestErrorKind::Field`] for a path that names no file, [`IngestErrorKind::NotARegularFile`] for one that is behind a link.
    pub(super) fn find(
        &self,
        paths: &[&str],
        place: impl Fn(usize) -> String,
    ) -> Result<ImageSearch, IngestError> {
        let paths: Vec<_> = paths.iter().map(|path| (*path, portable(path))).collect();
        let mut all = Vec::with_capacity(paths.len());
        for (index, (path, portable)) in paths.iter().enumerate() {
            all.push(stated(portable).map_err(|error| {
                IngestErrorKind::Field {
                    pointer: place(index),
                    message: format!("'{}': {error}", shown(path)),
                }
                .at(self.listing)
            })?);
        }
        let mut found = Vec::with_capacity(all.len());
        let mut in_place = BTreeSet::new();
        for stated in &all {
            let image = if stated.is_relative { self.in_place(*stated)? } else { None };
            if image.is_some() {
                in_place.insert(stated.folder);
            }
            found.push(image);
        }
        let moved = self.moved(&all, &found, &in_place)?;
        let mut search = ImageSearch {
            listed: found.len(),
            found,
            aliases: BTreeMap::new(),
            listing: self.listing.to_owned(),
            first_missing: Vec::new(),
            missing: Vec::new(),
            hint: None,
            moved: None,
        };
        for ((stated, (path, portable)), image) in all.iter().zip(&paths).zip(&mut search.found) {
            if image.is_some() {
                continue;
            }
            let folder = moved.get(stated.folder).copied().flatten();
            *image = folder.and_then(|folder| self.image_in(folder, stated.name));
            match image {
                Some(FoundImage { name, file }) => {
                    search.aliases.insert(normalized(portable).into_owned(), name.clone());
                    search.moved.get_or_insert_with(|| ((*path).to_owned(), file.clone()));
                }
                None => {
                    search.missing.push(normalized(portable).into_owned());
                    if search.first_missing.len() < MAX_MISSING_SHOWN {
                        search.first_missing.push(self.expected(*stated, portable));
                    }
                    if search.missing.len() == 1 {
                        search.hint = self.hint(*stated, &self.expected(*stated, portable));
                    }
                }
            }
        }
        Ok(search)
    }

    /// Where a missing photograph was looked for first.
    fn expected(&self, stated: Stated, path: &str) -> String {
        let folder = self.folders.first().copied().filter(|_| stated.is_relative).unwrap_or_default();
        format!("{folder}{}", safe_name(path).unwrap_or(path))
    }

    fn in_place(&self, stated: Stated) -> Result<Option<FoundImage>, IngestError> {
        let name = if stated.folder.is_empty() {
            stated.name.to_owned()
        } else {
            format!("{}/{}", stated.folder, stated.name)
        };
        for folder in self.folders {
            let exact = format!("{folder}{name}");
            if let Some(link) = self.tree.special_on_path(&exact) {
                return Err(link);
            }
            if let Some(file) = self.file(&exact) {
                return Ok(Some(FoundImage { name, file: file.to_owned() }));
            }
        }
        Ok(None)
    }

    /// The file of a name without or with the extension of an image. One of a format that is not read gives way to what it was converted to.
    fn file(&self, exact: &str) -> Option<&str> {
        if formats::by_name(exact).is_some()
            && let Some((stem, _)) = exact.rsplit_once('.')
            && let Some(converted) = self.with_extension(stem)
        {
            return Some(converted);
        }
        self.tree.find(exact).or_else(|| self.with_extension(exact))
    }

    fn with_extension(&self, exact: &str) -> Option<&str> {
        let mut names = IMAGE_EXTENSIONS.iter().flat_map(|extension| {
            [format!("{exact}.{extension}"), format!("{exact}.{}", extension.to_uppercase())]
        });
        names.find_map(|name| self.tree.find(&name))
    }

    /// The image of a name in another folder than the stated one.
    fn image_in(&self, folder: &str, name: &str) -> Option<FoundImage> {
        let path = if folder.is_empty() { name.to_owned() } else { format!("{folder}/{name}") };
        let file = self.file(&path).filter(|file| !self.taken.contains(*file))?.to_owned();
        let of = self.folders.iter().find_map(|folder| path.strip_prefix(folder));
        Some(FoundImage { name: of.unwrap_or(&path).to_owned(), file })
    }

    /// The folder that each stated folder is now, as far as there is one.
    fn moved<'s>(
        &'s self,
        all: &[Stated<'s>],
        found: &[Option<FoundImage>],
        in_place: &BTreeSet<&str>,
    ) -> Result<BTreeMap<&'s str, Option<&'s str>>, IngestError> {
        let mut wanted: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
        for (stated, _) in all.iter().zip(found).filter(|(_, image)| image.is_none()) {
            if !in_place.contains(stated.folder) {
                wanted.entry(stated.folder).or_default().insert(stated.name);
            }
        }
        if wanted.is_empty() {
            return Ok(BTreeMap::new());
        }
        let taken: BTreeSet<&str> = self
            .taken
            .iter()
            .chain(found.iter().flatten().map(|image| &image.file))
            .map(String::as_str)
            .collect();
        let places = Places::of(self.tree, &taken);
        let mut moved = BTreeMap::new();
        for (folder, names) in wanted {
            self.tree.check_time()?;
            moved.insert(folder, places.folder_of(folder, &names));
        }
        Ok(moved)
    }

    /// Why a file may be missing.
    fn hint(&self, stated: Stated, missing: &str) -> Option<MissingHint> {
        if self.tree.name_encoding() != NameEncoding::Utf8 && !missing.is_ascii() {
            return Some(MissingHint::CodePage);
        }
        let wanted = without_extension(missing);
        let by_case = self.tree.names().find(|name| name.eq_ignore_ascii_case(missing));
        let by_stem =
            || self.tree.names().find(|name| is_image_name(name) && without_extension(name) == wanted);
        let by_format = || {
            let mut unread = self.tree.names().filter_map(|name| Some((name, formats::by_name(name)?)));
            let stem = |name: &str| name.rsplit_once('.').map_or(0, |(stem, _)| stem.len());
            let (name, format) = unread.find(|(name, _)| name[..stem(name)] == *wanted)?;
            Some(MissingHint::Format(shown(name), format.name, format.remedy(name)))
        };
        let is_of_that_name = |file: &str| {
            let name = file.rsplit('/').next().unwrap_or(file);
            is_image_name(file) && (name == stated.name || without_extension(name) == stated.name)
        };
        let by_name = || {
            let places = self.tree.names().filter(|file| is_of_that_name(file)).take(MAX_PLACES).count();
            (places > 1).then(|| MissingHint::Places(places, shown(stated.name)))
        };
        let by_place = || {
            let outside = self.tree.outside().iter().find(|file| is_of_that_name(file))?;
            Some(MissingHint::Outside(shown(outside)))
        };
        by_case
            .map(|name| MissingHint::Case(name.to_owned()))
            .or_else(|| by_stem().map(|name| MissingHint::Extension(name.to_owned())))
            .or_else(by_format)
            .or_else(by_name)
            .or_else(by_place)
    }
}

impl ImageSearch {
    /// How many images are listed.
    pub(super) fn listed(&self) -> usize {
        self.listed
    }

    /// Whether no listed image is there.
    pub(super) fn is_empty(&self) -> bool {
        self.missing.len() == self.listed
    }

    /// The stated paths of missing images, in their normal form.
    pub(super) fn missing_paths(&self) -> impl Iterator<Item = &str> {
        self.missing.iter().map(|path| safe_name(path).unwrap_or(path))
    }

    /// Ends the search with a note on images found elsewhere, and on missing ones that are left out.
    ///
    /// # Errors
    /// [`IngestErrorKind::MissingImages`] if any was missing and is not left out, or all are.
    pub(super) fn finish(&self, read: &ReadOptions, notes: &mut Vec<String>) -> Result<(), IngestError> {
        let missing = self.missing.len();
        if missing > 0 && read.skip_missing && !self.is_empty() {
            let first: Vec<String> = self.first_missing.iter().map(|path| shown(path)).collect();
            notes.push(format!(
                "{missing} of the {} photographs of {} are missing and left out: {}",
                self.listed,
                self.listing,
                several(missing, &first)
            ));
        } else if missing > 0 {
            return Err(IngestErrorKind::MissingImages {
                count: missing,
                listed: self.listed,
                first: self.first_missing.clone(),
                hint: self.hint.clone(),
            }
            .at(self.listing.clone()));
        }
        if let Some((path, file)) = &self.moved {
            let count = self.aliases.len();
            let (photographs, are) = if count == 1 { ("photograph", "is") } else { ("photographs", "are") };
            notes.push(format!(
                "{count} {photographs} of {} {are} not where it says, and found by name: '{}' is {}",
                self.listing,
                shown(path),
                shown(file)
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_of_any_machine_come_apart() {
        let of = |path: &str| {
            let path = portable(path).into_owned();
            stated(&path).map(|stated| (stated.folder.to_owned(), stated.name.to_owned(), stated.is_relative))
        };
        for (path, folder, name, is_relative) in [
            ("./images/1.jpg", "images", "1.jpg", true),
            ("1.jpg", "", "1.jpg", true),
            (r"C:\Users\x\images\1.jpg", "C:/Users/x/images", "1.jpg", false),
            ("/home/x/images/1.jpg", "/home/x/images", "1.jpg", false),
            ("/1.jpg", "", "1.jpg", false),
            ("../images/1.jpg", "../images", "1.jpg", false),
            (r"\\server\share\1.jpg", "//server/share", "1.jpg", false),
        ] {
            assert_eq!(of(path).expect(path), (folder.to_owned(), name.to_owned(), is_relative), "{path}");
        }
        let long = format!("/{}/1.jpg", "x".repeat(5000));
        for path in ["", "/", "..", "/home/..", "C:1.jpg", "/a\0/1.jpg", "images/", long.as_str()] {
            assert!(matches!(of(path), Err(IngestErrorKind::UnsafeName(_))), "{path:?}");
        }
    }
}
