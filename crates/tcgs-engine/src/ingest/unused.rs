//! Notes on files of a dataset that are not used, so that nothing is left out in silence.
//!
//! Every file is used, of an operating system ([`super::names::is_os_metadata`]), or in a note. The number of notes and their length are
//! bounded, whatever a dataset holds.

use std::collections::{BTreeMap, BTreeSet};

use super::{error::shown, images::is_image_name, plan::folder_of, source::NameEncoding, tree::Tree};

/// How many folders of images have a note of their own.
const MAX_FOLDERS_NOTED: usize = 6;

/// How many other files a note names.
const MAX_FILES_SHOWN: usize = 6;

/// What a dataset's plan has taken of its files.
pub(super) struct Taken<'a> {
    /// Images that tables list, used or explained by another note.
    pub(super) listed: &'a BTreeSet<String>,
    /// Files that another note explains.
    pub(super) noted: &'a BTreeSet<String>,
    /// The tables that list images, for the notes.
    pub(super) listings: &'a [String],
}

/// Adds a note for every kind of file that is not used.
pub(super) fn note_unused(tree: &Tree, taken: &Taken, notes: &mut Vec<String>) {
    let used = tree.used();
    let is_unused =
        |name: &&str| !taken.listed.contains(*name) && !taken.noted.contains(*name) && !used.contains(*name);
    let (images, others): (Vec<&str>, Vec<&str>) =
        tree.names().filter(is_unused).partition(|name| is_image_name(name));
    note_images(&images, taken, notes);
    note_others(others, notes);
    let links: Vec<&str> = tree.special().collect();
    if let Some(text) = named(&links) {
        notes.push(format!("links and special files are not followed: {text}"));
    }
    if tree.skipped() > 0 {
        let (entries, are) = if tree.skipped() == 1 { ("entry", "is") } else { ("entries", "are") };
        notes.push(format!(
            "{} {entries} with names that no dataset can state {are} not used",
            tree.skipped()
        ));
    }
    if tree.name_encoding() == NameEncoding::CodePage {
        notes.push("names in the zip are in a local code page and not in UTF-8: letters beyond ASCII are not those of the tables".to_owned());
    }
}

/// Adds notes for files outside of the dataset's folder.
pub(super) fn note_outside(root: &str, images_of: Option<&str>, outside: &[String], notes: &mut Vec<String>) {
    if let Some(folder) = images_of {
        let folder = if folder.is_empty() { "the top" } else { folder };
        let (root, folder) = (shown(root), shown(folder));
        notes.push(format!("the dataset is in {root}, and its photographs are those of {folder}"));
    }
    let names: Vec<&str> = outside.iter().map(String::as_str).collect();
    if let Some(text) = named(&names) {
        notes.push(format!("the dataset is in {}; not used: {text}", shown(root)));
    }
}

fn note_images(images: &[&str], taken: &Taken, notes: &mut Vec<String>) {
    let with_photographs: BTreeSet<&str> = taken.listed.iter().map(|file| folder_of(file)).collect();
    let mut folders: BTreeMap<&str, usize> = BTreeMap::new();
    let mut unlisted = 0;
    for image in images {
        let folder = folder_of(image);
        if with_photographs.contains(folder) {
            unlisted += 1;
        } else {
            *folders.entry(folder).or_default() += 1;
        }
    }
    let counted = |count: usize| if count == 1 { ("image", "is") } else { ("images", "are") };
    if unlisted > 0 {
        let (images, are) = counted(unlisted);
        let listings = taken.listings.join(" or ");
        notes.push(format!("{unlisted} {images} {are} not listed in {listings} and not used"));
    }
    for (folder, count) in folders.iter().take(MAX_FOLDERS_NOTED) {
        let (images, are) = counted(*count);
        let place =
            if folder.is_empty() { "at the top".to_owned() } else { format!("in {}/", shown(folder)) };
        notes.push(format!("{count} {images} {place} {are} not used"));
    }
    let rest: usize = folders.values().skip(MAX_FOLDERS_NOTED).sum();
    if rest > 0 {
        let (images, are) = counted(rest);
        let folders = folders.len() - MAX_FOLDERS_NOTED;
        notes.push(format!("{rest} {images} in {folders} more folders {are} not used"));
    }
}

/// Point clouds go first: one that is not used changes the scene most.
fn note_others(mut others: Vec<&str>, notes: &mut Vec<String>) {
    let is_cloud = |name: &str| {
        name.rsplit_once('.').is_some_and(|(_, extension)| extension.eq_ignore_ascii_case("ply"))
    };
    others.sort_by_key(|name| (!is_cloud(name), name.matches('/').count()));
    if let Some(text) = named(&others) {
        notes.push(format!("not used: {text}"));
    }
}

/// The first names and the number of the others; `None` if there is none.
fn named(names: &[&str]) -> Option<String> {
    if names.is_empty() {
        return None;
    }
    let first: Vec<String> = names.iter().take(MAX_FILES_SHOWN).map(|name| shown(name)).collect();
    let more = names.len().saturating_sub(MAX_FILES_SHOWN);
    let files = if more == 1 { "file" } else { "files" };
    Some(if more == 0 { first.join(", ") } else { format!("{} and {more} more {files}", first.join(", ")) })
}
