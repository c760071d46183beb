//! Finds the models of a dataset and chooses the one with the most images.
//!
//! A reconstruction that falls apart leaves several models; what was meant is the one that nearly all photographs are in.

use std::collections::BTreeSet;

use super::{
    super::{error::shown, images::is_image_name, plan::folder_of, tree::Tree},
    binary::MIN_IMAGE_BYTES,
    text::{self, Lines},
};

/// Folders in which models lie, themselves or in folders of their own, in the order of preference. The last is the dataset's own, as for
/// tables beside the photographs.
const ROOTS: [&str; 3] = ["sparse/", "colmap/sparse/", ""];

/// How many of the models that are not used a note names.
const MAX_MODELS_NOTED: usize = 4;

/// A model's folder and the extension of its tables.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in super::super) struct Model {
    /// With a slash at its end.
    folder: String,
    extension: &'static str,
}

/// The model that is used, and those beside it.
pub(in super::super) struct Choice {
    pub(super) model: Model,
    /// Files of the others.
    pub(super) unused: BTreeSet<String>,
    /// Why it is this one, if there are others.
    pub(super) note: Option<String>,
}

impl Model {
    /// Its folder, with a slash at its end; empty for the dataset's own.
    pub(super) fn folder(&self) -> &str {
        &self.folder
    }

    /// The file of a table.
    pub(super) fn table(&self, name: &str) -> String {
        format!("{}{name}.{}", self.folder, self.extension)
    }

    /// Files that may have the points, the preferred first: of the tables' own encoding, of the other one, or a PLY file beside the tables.
    pub(super) fn points<'a>(&self, tree: &'a Tree) -> Vec<&'a str> {
        let mut extensions = vec![self.extension];
        extensions.extend(["bin", "txt", "ply"].into_iter().filter(|other| *other != self.extension));
        let names = extensions.into_iter().map(|extension| format!("{}points3D.{extension}", self.folder));
        names.filter_map(|name| tree.find_in_any_case(&name)).collect()
    }

    fn is_complete(&self, tree: &Tree) -> bool {
        tree.has(&self.table("cameras")) && tree.has(&self.table("images"))
    }

    /// How many images it has; 0 if that cannot be read.
    fn images(&self, tree: &Tree) -> u64 {
        let file = self.table("images");
        if self.extension == "txt" {
            let counted =
                tree.parse_unused(&file, u64::MAX, |reader, _| text::count_images(&mut Lines::new(reader)));
            return counted.map_or(0, |(count, ..)| count);
        }
        let head = tree.read_up_to(&file, 8).ok();
        let count = head.and_then(|head| head.try_into().ok()).map_or(0, u64::from_le_bytes);
        // A table that claims more than it has room for is no model.
        if count > tree.size(&file) / MIN_IMAGE_BYTES as u64 { 0 } else { count }
    }

    fn shown(&self) -> String {
        match self.folder.trim_end_matches('/') {
            "" => "the top".to_owned(),
            folder => shown(folder),
        }
    }
}

/// The model with the most images under the first folder that has any; the first of several that have as many.
pub(in super::super) fn detect(tree: &Tree) -> Option<Choice> {
    let mut models = ROOTS.iter().map(|root| models(tree, root)).find(|models| !models.is_empty())?;
    if models.iter().any(|model| model.is_complete(tree)) {
        models.retain(|model| model.is_complete(tree));
    }
    if models.len() == 1 {
        return models.pop().map(|model| Choice { model, unused: BTreeSet::new(), note: None });
    }
    let mut sized: Vec<(u64, Model)> = models.into_iter().map(|model| (model.images(tree), model)).collect();
    // Stable, so that models of equal size keep their order.
    sized.sort_by_key(|(images, _)| std::cmp::Reverse(*images));
    let mut sized = sized.into_iter();
    let (images, model) = sized.next()?;
    let others: Vec<_> = sized.collect();
    let folders: Vec<&str> = others.iter().map(|(_, other)| other.folder.as_str()).collect();
    let is_theirs = |name: &&str| {
        let folder = folder_of(name);
        !is_image_name(name) && folders.iter().any(|of| of.trim_end_matches('/') == folder)
    };
    let unused = tree.names().filter(is_theirs).map(str::to_owned).collect();
    let mut note = format!(
        "there are {} models: {} with {images} images is used, the largest",
        1 + others.len(),
        model.shown()
    );
    let named: Vec<String> = others
        .iter()
        .take(MAX_MODELS_NOTED)
        .map(|(images, other)| format!("{} with {images}", other.shown()))
        .collect();
    note += &format!("; not used: {}", named.join(", "));
    if others.len() > MAX_MODELS_NOTED {
        note += &format!(" and {} more", others.len() - MAX_MODELS_NOTED);
    }
    Some(Choice { model, unused, note: Some(note) })
}

/// The models under `root`, one a folder: numbered ones in their order, then others, then that of the root itself.
fn models(tree: &Tree, root: &str) -> Vec<Model> {
    let folder = |name: &str| {
        let (folder, file) =
            name.strip_prefix(root)?.rsplit_once('/').unwrap_or(("", name.strip_prefix(root)?));
        (matches!(file, "cameras.bin" | "cameras.txt") && !folder.contains('/')).then(|| folder.to_owned())
    };
    let folders: BTreeSet<String> = tree.names().filter_map(folder).collect();
    let mut folders: Vec<String> = folders.into_iter().collect();
    folders.sort_by_key(|folder| (folder.is_empty(), folder.parse::<u64>().unwrap_or(u64::MAX)));
    let model = |folder: String| {
        let folder = if folder.is_empty() { root.to_owned() } else { format!("{root}{folder}/") };
        let of = |extension| Model { folder: folder.clone(), extension };
        let encodings = ["bin", "txt"].map(of);
        let complete = encodings.iter().find(|model| model.is_complete(tree));
        complete.or_else(|| encodings.iter().find(|model| tree.has(&model.table("cameras")))).cloned()
    };
    folders.into_iter().filter_map(model).collect()
}
