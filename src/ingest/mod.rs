//! Zip archive or directory in, checked [`Dataset`] out.
//!
//! The road, one file a step: `tree` (files by safe names, from `folder` or `archive` and its `view`, within `limits`), then
//! `transforms` (by `json` and `fields`) or `colmap` (tables to a `plan`: frames, lenses, poses), then `survey` (sizes from image headers,
//! final cameras), then `images`, `distortion` and `sampling` (pixels).
//!
//! Memory is bounded by a [`Room`]: photographs are decoded in parallel as far as it has room for what that takes, stay in
//! memory as long as they fit, and go to a temporary file (`spill`) from there on.
//!
//! Input is untrusted. Whatever it is, the outcome is a dataset that keeps the promises of
//! [`crate::domain::scene`] or an [`Error`] that names the file and the fault: nothing panics, nothing is written outside of the
//! room, and no memory is asked for on the word of a header alone. A check takes less than 128 MiB, whatever it is given
//! ([`Limits`]), and [`Checks`] bounds how many run at a time and how long each may take.

mod archive;
mod bytes;
mod central_directory;
mod checks;
mod colmap;
mod deadline;
mod distortion;
mod error;
mod fields;
mod folder;
mod images;
mod json;
mod lens;
mod limits;
mod names;
mod pack;
mod plan;
mod ply;
mod points;
mod room;
mod sampling;
mod spill;
mod survey;
mod transforms;
mod tree;
mod view;

#[cfg(test)]
mod fixtures;
#[cfg(test)]
mod tests;

use std::path::Path;

use rayon::prelude::*;

pub use self::{
    checks::Checks,
    error::{Error, Fault},
    limits::Limits,
    pack::pack,
    room::Room,
};
use self::{
    deadline::Deadline,
    room::Permits,
    spill::Spill,
    survey::{Survey, View, survey},
    tree::{Purpose, Tree},
};
use crate::domain::{Bytes, Dataset, DatasetSummary, Frame, Photograph, Problem, Split};

/// Reads a dataset from a directory or a zip file, told apart by what `path` is.
///
/// # Errors
/// A [`Problem`] that names the file and the fault: 400 for what is no zip archive, 413 for what is over the
/// default [`Limits`], 404 for a path that does not exist, 500 for one that cannot be read, 507 for what memory or disk have
/// no room for, else 422.
pub fn load(path: &Path) -> Result<Dataset, Problem> {
    load_into(path, &Room::default())
}

/// As [`load`], with memory and a place for temporary files of the caller's choice.
///
/// # Errors
/// As [`load`].
pub fn load_into(path: &Path, room: &Room) -> Result<Dataset, Problem> {
    Ok(load_watched(path, room, &|| true)?)
}

/// As [`load_into`]; `go_on` is asked before each image's header and again before its pixels, by whichever thread reads them; once it says no,
/// the reading ends.
///
/// # Errors
/// As [`load_within`], and [`Fault::Stopped`].
pub fn load_watched(path: &Path, room: &Room, go_on: &(dyn Fn() -> bool + Sync)) -> Result<Dataset, Error> {
    load_asking(path, &Limits::default(), room, go_on)
}

/// Checks a dataset as far as possible without decoding pixels: the archive, the layout, poses, cameras, points, and
/// the presence and size of every image.
///
/// # Errors
/// As [`load`].
pub fn check(path: &Path) -> Result<DatasetSummary, Problem> {
    Ok(check_within(path, &Limits::default())?)
}

/// As [`load`], within other limits.
///
/// # Errors
/// The first fault, in the order of names.
pub fn load_within(path: &Path, limits: &Limits, room: &Room) -> Result<Dataset, Error> {
    load_asking(path, limits, room, &|| true)
}

fn load_asking(
    path: &Path,
    limits: &Limits,
    room: &Room,
    go_on: &(dyn Fn() -> bool + Sync),
) -> Result<Dataset, Error> {
    let (tree, survey) = survey(Tree::open(path, limits)?, limits, go_on)?;
    let store = Store::new(&tree, &survey, room)?;
    // Collected before the first fault is taken, so that the same fault is reported whatever thread is faster.
    let frames: Vec<Result<Frame, Error>> = survey
        .views
        .into_par_iter()
        .map(|view| {
            if !go_on() {
                return Err(Fault::Stopped.into());
            }
            let image = store.photograph(&tree, &view, limits)?;
            Ok(Frame { name: view.shot.name, camera: view.camera, image, split: view.shot.split })
        })
        .collect();
    Ok(Dataset {
        layout: survey.layout,
        frames: frames.into_iter().collect::<Result<_, _>>()?,
        points: survey.points,
        digest: tree.digest(),
        notes: survey.notes,
    })
}

/// Where photographs go once they are decoded, and how many are decoded at a time.
struct Store {
    decoding: Permits,
    kept: Permits,
    spill: Spill,
}

impl Store {
    /// A quarter of the room is for decoding, or as much as the largest image takes; the rest keeps images.
    ///
    /// # Errors
    /// [`Fault::DecodeMemory`] if the room is too small for the largest image.
    fn new(tree: &Tree, survey: &Survey, room: &Room) -> Result<Self, Error> {
        let needed = survey.views.iter().map(|view| (Self::decode_bytes(tree, view), &view.shot.file)).max();
        let (largest, file) = needed.ok_or(Fault::NoImages)?;
        if largest > room.memory {
            let (bytes, budget) = (Bytes(largest), Bytes(room.memory));
            return Err(Fault::DecodeMemory { bytes, budget }.at(file));
        }
        let threads = rayon::current_num_threads() as u64;
        let decoding = largest.saturating_mul(threads).min(room.memory / 4).max(largest);
        Ok(Self {
            decoding: Permits::new(decoding),
            kept: Permits::new(room.memory - decoding),
            spill: Spill::new(&room.spill),
        })
    }

    /// The file, which is read into a buffer that doubles as it grows, and what is made of it.
    fn decode_bytes(tree: &Tree, view: &View) -> u64 {
        view.decode_bytes().saturating_add(tree.size(&view.shot.file).saturating_mul(2))
    }

    fn photograph(&self, tree: &Tree, view: &View, limits: &Limits) -> Result<Photograph, Error> {
        let _permit = self.decoding.take(Self::decode_bytes(tree, view));
        let file = &view.shot.file;
        let bytes = tree.read(file)?;
        let image = images::decode(&bytes, limits)
            .and_then(|image| view.finish(image))
            .map_err(|fault| fault.at(file))?;
        if self.kept.keep(image.samples().len() as u64) {
            Ok(image.into())
        } else {
            Ok(self.spill.put(&image)?)
        }
    }
}

/// As [`check`], within other limits.
///
/// # Errors
/// The first fault, in the order of names.
pub fn check_within(path: &Path, limits: &Limits) -> Result<DatasetSummary, Error> {
    check_by(Deadline::NONE, path, limits)
}

fn check_by(deadline: Deadline, path: &Path, limits: &Limits) -> Result<DatasetSummary, Error> {
    let tree = Tree::open_for(Purpose::Check(deadline), path, limits)?;
    let (_, survey) = survey(tree, limits, &|| true)?;
    let count = |split| survey.views.iter().filter(|view| view.shot.split == split).count();
    let pixels = survey.views.iter().map(|view| {
        let k = view.camera.intrinsics;
        u64::from(k.width) * u64::from(k.height)
    });
    Ok(DatasetSummary {
        layout: survey.layout,
        train: count(Split::Train),
        test: count(Split::Test),
        pixels: pixels.sum(),
        points: survey.point_count,
        notes: survey.notes,
    })
}
