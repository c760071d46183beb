//! Finds the masks of photographs: where a transforms file states them, in folders of masks, or beside their photographs.
//!
//! A photograph that a table lists is no mask, whatever its name. Nothing is left out in silence: a folder of masks of which none belongs
//! to a photograph is an error, and photographs without a mask are noted.

use std::{
    collections::HashMap,
    hash::{DefaultHasher, Hash as _, Hasher as _},
    sync::Arc,
};

use super::{
    error::{IngestError, IngestErrorKind, shown},
    images::is_image_name,
    masks::{is_mask_folder, name_of, photographs_of, stem_of},
    names::{portable, safe_name},
    plan::{Plan, StatedMask, folder_of},
    tree::Tree,
};
use crate::domain::{MaskSource, dataset::IMAGE_EXTENSIONS};

/// Most masks of one photograph: a pixel counts only if it does in all of them.
const MAX_MASKS: usize = 4;

/// How many of the folders that a file lies in tell photographs of one name apart.
const MAX_FOLDERS: usize = 3;

/// How many places of masks a note names.
const MAX_PLACES: usize = 4;

/// The masks of a dataset.
#[derive(Debug, Default)]
pub(super) struct FoundMasks {
    /// Of each frame, by its place in the plan.
    pub(super) of_frames: Vec<Vec<String>>,
    /// Where they are, for the notes.
    pub(super) places: Vec<String>,
}

impl FoundMasks {
    /// How many photographs have a mask.
    pub(super) fn count(&self) -> usize {
        self.of_frames.iter().filter(|masks| !masks.is_empty()).count()
    }

    fn add(&mut self, frame: usize, mask: &str, place: String) -> Result<(), IngestError> {
        let masks = &mut self.of_frames[frame];
        if masks.len() == MAX_MASKS {
            return Err(IngestErrorKind::TooManyMasks { limit: MAX_MASKS }.at(mask));
        }
        masks.push(mask.to_owned());
        if self.places.len() < MAX_PLACES && !self.places.contains(&place) {
            self.places.push(place);
        }
        Ok(())
    }
}

/// The masks of the frames of a plan.
///
/// # Errors
/// Masks that are stated and missing, folders of masks of which none belongs to a photograph, and masks that could belong to several.
pub(super) fn find_masks(tree: &Tree, plan: &Plan, source: &MaskSource) -> Result<FoundMasks, IngestError> {
    let mut found = FoundMasks { of_frames: vec![Vec::new(); plan.frames.len()], places: Vec::new() };
    match source {
        MaskSource::None => {}
        MaskSource::Folder(folder) => {
            let folder = folder.trim_end_matches('/').trim_start_matches("./");
            if !Search::of(tree, plan).in_folder(folder, &mut found)? {
                return Err(IngestErrorKind::NoMaskFolder { folder: shown(folder) }.into());
            }
        }
        MaskSource::Auto if plan.frames.iter().any(|frame| frame.mask.is_some()) => {
            stated(tree, plan, &mut found)?;
        }
        MaskSource::Auto => Search::of(tree, plan).by_names(&mut found)?,
    }
    Ok(found)
}

/// Takes the masks that transforms files state.
fn stated(tree: &Tree, plan: &Plan, found: &mut FoundMasks) -> Result<(), IngestError> {
    // What is stated for all frames is resolved once.
    let mut last: Option<(&Arc<StatedMask>, Option<String>)> = None;
    for (index, frame) in plan.frames.iter().enumerate() {
        let Some(mask) = &frame.mask else { continue };
        let file = match &last {
            Some((resolved, file)) if Arc::ptr_eq(resolved, mask) => file.clone(),
            _ => {
                let file = resolved(tree, plan, mask, found)?;
                last = Some((mask, file.clone()));
                file
            }
        };
        if let Some(file) = file {
            found.add(index, &file, format!("named in {}", mask.listing))?;
        }
    }
    Ok(())
}

/// The file that a mask is in; `None` if the path is that of a folder, whose masks are added.
fn resolved(
    tree: &Tree,
    plan: &Plan,
    mask: &StatedMask,
    found: &mut FoundMasks,
) -> Result<Option<String>, IngestError> {
    let StatedMask { listing, place, path } = mask;
    let not_a_path = || IngestErrorKind::Masks { place: place.clone() }.at(listing);
    let path = path.as_deref().ok_or_else(not_a_path)?;
    let portable = portable(path);
    let name = safe_name(portable.trim_end_matches('/')).map_err(|error| {
        IngestErrorKind::Field { pointer: place.clone(), message: format!("'{}': {error}", shown(path)) }
            .at(listing)
    })?;
    if let Some(link) = tree.special_on_path(name) {
        return Err(link);
    }
    let with_extensions = IMAGE_EXTENSIONS.iter().map(|extension| format!("{name}.{extension}"));
    let mut names = std::iter::once(name.to_owned()).chain(with_extensions);
    if let Some(file) = names.find_map(|name| tree.find(&name).map(str::to_owned)) {
        return Ok(Some(file));
    }
    if Search::of(tree, plan).in_folder(name, found)? {
        return Ok(None);
    }
    Err(IngestErrorKind::MissingMask { place: place.clone(), path: shown(path) }.at(listing))
}

/// The photographs that a name may mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Named {
    One(usize),
    Several,
}

/// Finds photographs by the names of masks.
struct Search<'a> {
    tree: &'a Tree,
    plan: &'a Plan,
    /// By a hash of the name or of its stem, behind up to [`MAX_FOLDERS`] folders: names themselves would take much memory.
    named: HashMap<u64, Named>,
    folders: std::collections::BTreeSet<&'a str>,
}

impl<'a> Search<'a> {
    fn of(tree: &'a Tree, plan: &'a Plan) -> Self {
        let mut named = HashMap::new();
        for (index, frame) in plan.frames.iter().enumerate() {
            let folders: Vec<String> = parts(folder_of(&frame.file));
            let name = name_of(&frame.file).to_lowercase();
            for depth in 0..=folders.len().min(MAX_FOLDERS) {
                let behind = &folders[folders.len() - depth..];
                for name in [name.as_str(), stem_of(&name)] {
                    let entry = named.entry(key(behind, name)).or_insert(Named::One(index));
                    if *entry != Named::One(index) {
                        *entry = Named::Several;
                    }
                }
            }
        }
        let folders = plan.listed.iter().map(|file| folder_of(file)).collect();
        Self { tree, plan, named, folders }
    }

    /// The photograph that a mask in `folder` is for; of several, the one in the folder of that name.
    fn photograph(&self, mask: &str, folder: &str, in_folder: bool) -> Result<Option<usize>, IngestError> {
        let folders: Vec<String> = parts(folder).into_iter().filter(|part| !is_mask_folder(part)).collect();
        let names = photographs_of(name_of(mask), in_folder);
        let mut several = false;
        for depth in (0..=folders.len().min(MAX_FOLDERS)).rev() {
            for name in &names {
                match self.named.get(&key(&folders[folders.len() - depth..], name)) {
                    Some(Named::One(index)) => return Ok(Some(*index)),
                    Some(Named::Several) => several = true,
                    None => {}
                }
            }
        }
        if several { Err(IngestErrorKind::AmbiguousMask.at(mask)) } else { Ok(None) }
    }

    fn images(&self) -> impl Iterator<Item = &'a str> {
        let Self { tree, plan, .. } = *self;
        tree.names().filter(|name| is_image_name(name) && !plan.listed.contains(*name))
    }

    /// Takes the masks in a folder; returns whether there is an image in it.
    ///
    /// # Errors
    /// [`IngestErrorKind::NoMaskMatches`] if none of the images belongs to a photograph.
    fn in_folder(&self, folder: &str, found: &mut FoundMasks) -> Result<bool, IngestError> {
        let (mut images, mut matched) = (0, 0);
        for image in self.images() {
            let Some(rest) = image.strip_prefix(folder).and_then(|rest| rest.strip_prefix('/')) else {
                continue;
            };
            images += 1;
            if let Some(frame) = self.photograph(image, folder_of(rest), true)? {
                found.add(frame, image, format!("in {}/", shown(folder)))?;
                matched += 1;
            }
        }
        if images > 0 && matched == 0 {
            return Err(IngestErrorKind::NoMaskMatches { folder: shown(folder), images }.into());
        }
        Ok(images > 0)
    }

    /// Takes the masks in folders of masks and those beside photographs.
    ///
    /// # Errors
    /// [`IngestErrorKind::NoMaskMatches`] if there are folders of masks and none of their images belongs to a photograph.
    fn by_names(&self, found: &mut FoundMasks) -> Result<(), IngestError> {
        let (mut first, mut images, mut matched) = (None, 0, 0);
        for image in self.images() {
            let folder = folder_of(image);
            if folder.split('/').any(is_mask_folder) {
                images += 1;
                first.get_or_insert(folder);
                if let Some(frame) = self.photograph(image, folder, true)? {
                    found.add(frame, image, format!("in {}/", shown(folder)))?;
                    matched += 1;
                }
            } else if self.folders.contains(folder)
                && let Some(frame) = self.beside(image)?
            {
                found.add(frame, image, "beside the photographs".to_owned())?;
            }
        }
        match first {
            Some(folder) if matched == 0 => {
                Err(IngestErrorKind::NoMaskMatches { folder: shown(folder), images }.into())
            }
            _ => Ok(()),
        }
    }

    /// The photograph beside a mask. Others of its name in other folders do not matter.
    fn beside(&self, image: &str) -> Result<Option<usize>, IngestError> {
        match self.photograph(image, folder_of(image), false) {
            Ok(Some(frame)) if folder_of(&self.plan.frames[frame].file) == folder_of(image) => {
                Ok(Some(frame))
            }
            Ok(_) => Ok(None),
            Err(error) => Err(error),
        }
    }
}

/// The folders of a path, in lower case.
fn parts(folder: &str) -> Vec<String> {
    folder.split('/').filter(|part| !part.is_empty()).map(str::to_lowercase).collect()
}

fn key(folders: &[String], name: &str) -> u64 {
    let mut hasher = DefaultHasher::new();
    folders.hash(&mut hasher);
    name.hash(&mut hasher);
    hasher.finish()
}
