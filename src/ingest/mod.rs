//! Zip archive or directory in, checked [`Dataset`] out.
//!
//! The road, one file a step: `tree` (files by safe names, from `folder` or `archive`, within `limits`), then
//! `transforms` or `colmap` (tables to a `plan`: frames, lenses, poses), then `survey` (sizes from image headers,
//! final cameras), then `images`, `distortion` and `sampling` (pixels).
//!
//! Input is untrusted. Whatever it is, the outcome is a dataset that keeps the promises of
//! [`crate::domain::scene`] or an [`Error`] that names the file and the fault: nothing panics, nothing is written,
//! and no memory is asked for on the word of a header alone.

mod archive;
mod bytes;
mod colmap;
mod distortion;
mod error;
mod folder;
mod images;
mod lens;
mod limits;
mod names;
mod plan;
mod ply;
mod sampling;
mod survey;
mod transforms;
mod tree;

#[cfg(test)]
mod fixtures;
#[cfg(test)]
mod tests;

use std::path::Path;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use self::{
    error::{Error, Fault},
    limits::Limits,
};
use self::{survey::survey, tree::Tree};
use crate::domain::{Dataset, Frame, Layout, Problem, Split};

/// What can be told about a dataset without decoding its pixels.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Summary {
    /// How its files are laid out.
    pub layout: Layout,
    /// Frames to train on.
    pub train: usize,
    /// Frames held out.
    pub test: usize,
    /// Pixels of all images as they will be trained on.
    pub pixels: u64,
    /// Structure-from-motion points, if it has any.
    pub points: Option<usize>,
    /// As [`Dataset::notes`].
    pub notes: Vec<String>,
}

/// Reads a dataset from a directory or a zip file, told apart by what `path` is.
///
/// # Errors
/// A [`Problem`] that names the file and the fault: 400 for what is no zip archive, 413 for what is over the
/// default [`Limits`], 404 for a path that does not exist, 500 for one that cannot be read, else 422.
pub fn load(path: &Path) -> Result<Dataset, Problem> {
    Ok(load_within(path, &Limits::default())?)
}

/// Checks a dataset as far as possible without decoding pixels: the archive, the layout, poses, cameras, points, and
/// the presence and size of every image.
///
/// # Errors
/// As [`load`].
pub fn check(path: &Path) -> Result<Summary, Problem> {
    Ok(check_within(path, &Limits::default())?)
}

/// As [`load`], within other limits.
///
/// # Errors
/// The first fault, in the order of names.
pub fn load_within(path: &Path, limits: &Limits) -> Result<Dataset, Error> {
    let (tree, survey) = survey(Tree::open(path, limits)?, limits)?;
    // Collected before the first fault is taken, so that the same fault is reported whatever thread is faster.
    let frames: Vec<Result<Frame, Error>> = survey
        .views
        .into_par_iter()
        .map(|view| {
            let file = &view.shot.file;
            let image = images::decode(&tree.read(file)?, limits)
                .and_then(|image| view.finish(image))
                .map_err(|fault| fault.at(file))?;
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

/// As [`check`], within other limits.
///
/// # Errors
/// The first fault, in the order of names.
pub fn check_within(path: &Path, limits: &Limits) -> Result<Summary, Error> {
    let (_, survey) = survey(Tree::open(path, limits)?, limits)?;
    let count = |split| survey.views.iter().filter(|view| view.shot.split == split).count();
    let pixels = survey.views.iter().map(|view| {
        let k = view.camera.intrinsics;
        u64::from(k.width) * u64::from(k.height)
    });
    Ok(Summary {
        layout: survey.layout,
        train: count(Split::Train),
        test: count(Split::Test),
        pixels: pixels.sum(),
        points: survey.points.as_ref().map(|points| points.positions.len()),
        notes: survey.notes,
    })
}
