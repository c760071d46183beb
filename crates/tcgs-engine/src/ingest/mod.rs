//! Reads a dataset from a zip archive or a directory into a checked [`Dataset`].
//!
//! In order: `tree` lists files by safe names (from `folder`, or `archive` behind `end_record`) within `limits`; `roots` finds the
//! dataset's folder; `transforms` (with `bounded_json` and `fields`) or `colmap` reads the tables into a `plan` of frames, lenses and poses,
//! whose files `image_files` finds; `survey` reads image headers and computes the final cameras; `images`, `orientation`, `distortion` (with
//! `projection` and `valid_region`) and `sampling` produce the pixels; `mask_search` (with `masks`) and `mask_reader` (with `mask_pixels`)
//! find masks and read them. `unused` sees to it that nothing in a dataset is left out in silence. `unposed` checks photographs, or a
//! video, that no file says the cameras of.
//!
//! Memory is bounded by a [`LoadBudget`]: as many photographs are decoded in parallel as it allows, they stay in memory as long as they
//! fit, and the others go to a temporary file (`spill`).
//!
//! Input is untrusted. Whatever it is, the result is a dataset that satisfies [`crate::domain::dataset`] or an [`IngestError`] that names
//! the file and the reason: nothing panics, nothing is written outside of the spill file, and no allocation follows a header's claim
//! alone. A check takes less than 128 MiB for any input ([`Limits`]); [`DatasetChecker`] limits how many run at a time and for how long.

mod archive;
mod bounded_json;
mod budget;
mod central_directory;
mod checker;
mod colmap;
mod deadline;
mod disk_faults;
mod distortion;
mod end_record;
mod error;
mod error_text;
mod fields;
mod finish;
mod folder;
mod formats;
mod image_files;
mod image_places;
mod images;
mod lens;
mod limits;
mod mask_pixels;
mod mask_reader;
mod mask_search;
mod masks;
mod names;
mod orientation;
mod pack;
mod plan;
mod ply;
mod points;
mod projection;
mod provenance;
mod roots;
mod sampling;
mod semaphore;
mod source;
mod sparse_model;
mod spill;
mod survey;
mod survey_notes;
mod surveyed_frame;
mod table_reader;
mod transforms;
mod tree;
mod unposed;
mod unposed_masks;
mod unused;
mod valid_region;
mod video;

#[cfg(test)]
mod fixtures;
#[cfg(test)]
mod mask_tests;
#[cfg(test)]
mod report_tests;
#[cfg(test)]
mod sent_tests;
#[cfg(test)]
mod tests;

use std::path::Path;

use rayon::prelude::*;

pub use self::{
    budget::{LoadBudget, large_file_dir},
    checker::DatasetChecker,
    error::{IngestError, IngestErrorKind, MissingHint},
    limits::Limits,
    pack::{PackError, pack},
    provenance::POSES_RECORD,
    sparse_model::sparse_model,
    unposed::Unposed,
};
use self::{
    deadline::Deadline,
    semaphore::Semaphore,
    spill::Spill,
    survey::{Survey, SurveyOptions, survey},
    surveyed_frame::SurveyedFrame,
    tree::{Purpose, Tree},
};
use crate::domain::{
    Bytes, Dataset, DatasetSummary, Frame, NamedCamera, Photograph, PixelMask, Problem, ReadOptions, Split,
};

/// Reads a dataset from a directory or a zip file, whichever `path` is.
///
/// # Errors
/// A [`Problem`] that names the file and the error: 400 for a file that is not a zip archive, 413 for a dataset over the
/// default [`Limits`], 404 for a path that does not exist, 500 for one that cannot be read, 507 for one that exceeds memory
/// or disk, else 422.
pub fn load(path: &Path) -> Result<Dataset, Problem> {
    load_with_budget(path, &LoadBudget::default())
}

impl Dataset {
    /// Reads a dataset from a directory or a zip file, in the layout of COLMAP, nerfstudio or Blender. Its photographs are undistorted
    /// and stay in memory as far as they fit, else in a temporary file.
    ///
    /// # Errors
    /// A [`Problem`] that names the file and the error: 422 for a dataset that is not understood, 413 for one over the limits, 404 for a
    /// path that does not exist, 400 for a file that is not a zip archive, 500 and 507 for want of a readable disk, memory or space.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, Problem> {
        load(path.as_ref())
    }
}

/// As [`load`], with memory and a place for temporary files of the caller's choice.
///
/// # Errors
/// As [`load`].
pub fn load_with_budget(path: &Path, budget: &LoadBudget) -> Result<Dataset, Problem> {
    Ok(load_cancellable(path, budget, &|| true)?)
}

/// As [`load_with_budget`]; `should_continue` is called before each image's header and pixels are read, by the thread that reads them.
/// Once it returns false, loading stops.
///
/// # Errors
/// The first error, in the order of names, and [`IngestErrorKind::Stopped`].
pub fn load_cancellable(
    path: &Path,
    budget: &LoadBudget,
    should_continue: &(dyn Fn() -> bool + Sync),
) -> Result<Dataset, IngestError> {
    load_as(path, &ReadOptions::default(), budget, should_continue)
}

/// As [`load_cancellable`], read as the caller chooses.
///
/// # Errors
/// As [`load_cancellable`].
pub fn load_as(
    path: &Path,
    reading: &ReadOptions,
    budget: &LoadBudget,
    should_continue: &(dyn Fn() -> bool + Sync),
) -> Result<Dataset, IngestError> {
    let reading = reading.clone();
    let options = SurveyOptions { reading, decode_bytes: budget.memory_bytes, should_continue };
    load_with(path, &Limits::default(), budget, &options)
}

/// As [`load_as`], with at most `most` of the photographs to train on, evenly along their order, and none that is held out.
///
/// # Errors
/// As [`load_cancellable`].
pub fn load_sample(
    path: &Path,
    reading: &ReadOptions,
    most: usize,
    budget: &LoadBudget,
    should_continue: &(dyn Fn() -> bool + Sync),
) -> Result<Dataset, IngestError> {
    let reading = reading.clone();
    let options = SurveyOptions { reading, decode_bytes: budget.memory_bytes, should_continue };
    load_thinned(path, &Limits::default(), budget, &options, Some(most))
}

/// Checks a dataset as far as possible without decoding pixels: the archive, the layout, poses, cameras, points, and
/// the presence and size of every image.
///
/// # Errors
/// As [`load`].
pub fn check(path: &Path) -> Result<DatasetSummary, Problem> {
    Ok(check_within(path, &Limits::default())?)
}

/// Whether `path` has photographs, or a video, that no file says the cameras of. Of a dataset with cameras nothing else is reported: that
/// is left to who loads it.
///
/// # Errors
/// What is wrong with the photographs or the video, as [`check`] says it.
pub fn lacks_cameras(path: &Path, reading: &ReadOptions) -> Result<bool, Problem> {
    let limits = Limits::default();
    let options = SurveyOptions { reading: reading.clone(), decode_bytes: 0, should_continue: &|| true };
    match survey_for(Purpose::Check(Deadline::NONE), path, &limits, &options) {
        Err(error) if is_without_layout(&error) => {
            match unposed::check(Deadline::NONE, path, &limits, reading.max_width) {
                // Loading says where a layout was looked for.
                Err(error) if is_without_layout(&error) => Ok(false),
                checked => Ok(checked.map(|_| true)?),
            }
        }
        Ok(_) | Err(_) => Ok(false),
    }
}

/// The cameras of a dataset's frames, in the order of [`Dataset::frames`], checked as [`check`] does.
///
/// # Errors
/// As [`load`].
pub fn cameras(path: &Path) -> Result<Vec<NamedCamera>, Problem> {
    Ok(check_with_cameras(path)?.1)
}

/// What [`check`] and [`cameras`] return, from one reading of the dataset. Unlike [`check`], it decodes the photographs whose EXIF
/// orientation only their pixels decide, so that the cameras and notes are those of loading.
///
/// # Errors
/// As [`load`].
pub fn check_with_cameras(path: &Path) -> Result<(DatasetSummary, Vec<NamedCamera>), Problem> {
    check_as(path, &ReadOptions::default())
}

/// As [`check_with_cameras`], read as the caller chooses.
///
/// # Errors
/// As [`load`].
pub fn check_as(path: &Path, reading: &ReadOptions) -> Result<(DatasetSummary, Vec<NamedCamera>), Problem> {
    let decode_bytes = LoadBudget::default().memory_bytes;
    let reading = reading.clone();
    let options = SurveyOptions { reading, decode_bytes, should_continue: &|| true };
    match survey_for(Purpose::Load, path, &Limits::default(), &options) {
        Ok(survey) => Ok((survey.summary(), survey.into_cameras())),
        Err(error) if is_without_layout(&error) => {
            let width = options.reading.max_width;
            Ok((unposed::check(Deadline::NONE, path, &Limits::default(), width)?, Vec::new()))
        }
        Err(error) => Err(error.into()),
    }
}

/// As [`load_cancellable`], within other limits.
///
/// # Errors
/// The first error, in the order of names.
fn load_with(
    path: &Path,
    limits: &Limits,
    budget: &LoadBudget,
    options: &SurveyOptions,
) -> Result<Dataset, IngestError> {
    load_thinned(path, limits, budget, options, None)
}

/// All photographs, or at most `most` of those to train on.
fn load_thinned(
    path: &Path,
    limits: &Limits,
    budget: &LoadBudget,
    options: &SurveyOptions,
    most: Option<usize>,
) -> Result<Dataset, IngestError> {
    let tree = Tree::open(Purpose::Load, path, limits)?;
    let faults = tree.disk_faults();
    let loaded = survey(tree, limits, options).and_then(|(tree, mut survey)| {
        if let Some(most) = most {
            survey.thin_out(most);
        }
        load_surveyed(tree, survey, limits, budget, options)
    });
    loaded.map_err(|error| faults.or(error))
}

fn load_surveyed(
    tree: Tree,
    survey: Survey,
    limits: &Limits,
    budget: &LoadBudget,
    options: &SurveyOptions,
) -> Result<Dataset, IngestError> {
    let store = Store::new(&tree, &survey, budget)?;
    // Collected before the first error is taken, so that the same error is reported whatever thread is faster.
    let frames: Vec<Result<Frame, IngestError>> = survey
        .views
        .into_par_iter()
        .map(|view| {
            if !(options.should_continue)() {
                return Err(IngestErrorKind::Stopped.into());
            }
            let (image, mask) = store.photograph(&tree, &view, limits)?;
            let mask = match (mask, view.valid_pixels()) {
                (Some(mask), Some(valid)) => mask.and(&valid),
                (mask, valid) => mask.or(valid),
            };
            Ok(Frame { name: view.frame.name, camera: view.camera, image, mask, split: view.frame.split })
        })
        .collect();
    let frames: Vec<Frame> = frames.into_iter().collect::<Result<_, _>>()?;
    let mut notes = survey.notes;
    let frames = without_hidden(frames, &mut notes)?;
    Ok(Dataset { layout: survey.layout, frames, points: survey.points, digest: tree.digest(), notes })
}

/// The frames of which any pixel counts.
///
/// # Errors
/// [`IngestErrorKind::AllHidden`] if there is none to train on.
fn without_hidden(mut frames: Vec<Frame>, notes: &mut Vec<String>) -> Result<Vec<Frame>, IngestError> {
    let before = frames.len();
    frames.retain(|frame| frame.mask.as_ref().is_none_or(|mask| mask.counted() > 0));
    if !frames.iter().any(|frame| frame.split == Split::Train) {
        return Err(IngestErrorKind::AllHidden.into());
    }
    if frames.len() < before {
        let hidden = before - frames.len();
        notes.push(format!("photographs of which masks hide every pixel, left out: {hidden}"));
    }
    Ok(frames)
}

/// Where photographs go once they are decoded, and how many are decoded at a time.
struct Store {
    decoding: Semaphore,
    kept: Semaphore,
    spill: Spill,
}

impl Store {
    /// A quarter of the budget is for decoding, or as much as the largest image takes; the rest keeps images.
    ///
    /// # Errors
    /// [`IngestErrorKind::DecodeMemory`] if the budget is too small for the largest image.
    fn new(tree: &Tree, survey: &Survey, budget: &LoadBudget) -> Result<Self, IngestError> {
        let needed = survey.views.iter().map(|view| (Self::decode_bytes(tree, view), &view.frame.file)).max();
        let (largest, file) = needed.ok_or(IngestErrorKind::NoImages)?;
        if largest > budget.memory_bytes {
            let (bytes, budget) = (Bytes(largest), Bytes(budget.memory_bytes));
            return Err(IngestErrorKind::DecodeMemory { bytes, budget }.at(file));
        }
        let threads = rayon::current_num_threads() as u64;
        let decoding = largest.saturating_mul(threads).min(budget.memory_bytes / 4).max(largest);
        Ok(Self {
            decoding: Semaphore::new(decoding),
            kept: Semaphore::new(budget.memory_bytes - decoding),
            spill: Spill::new(&budget.spill_dir),
        })
    }

    /// Bytes for the file, whose buffer doubles as it grows, and for decoding it.
    fn decode_bytes(tree: &Tree, view: &SurveyedFrame) -> u64 {
        view.decode_bytes().saturating_add(tree.size(&view.frame.file).saturating_mul(2))
    }

    fn photograph(
        &self,
        tree: &Tree,
        view: &SurveyedFrame,
        limits: &Limits,
    ) -> Result<(Photograph, Option<PixelMask>), IngestError> {
        let _held = self.decoding.acquire(Self::decode_bytes(tree, view));
        let file = &view.frame.file;
        let bytes = tree.read(file)?;
        let image = images::decode(&bytes, view.turn, limits).map_err(|error| error.at(file))?;
        drop(bytes);
        let (image, mask) = view.finish_with_masks(tree, image, limits)?;
        // A mask stays in memory in any case: it has a 24th of the bytes.
        let mask_bytes = mask.as_ref().map_or(0, PixelMask::bytes_in_memory);
        if self.kept.try_keep(mask_bytes + image.samples().len() as u64) {
            Ok((image.into(), mask))
        } else {
            Ok((self.spill.put(&image)?, mask))
        }
    }
}

/// As [`check`], within other limits.
///
/// # Errors
/// The first error, in the order of names.
pub fn check_within(path: &Path, limits: &Limits) -> Result<DatasetSummary, IngestError> {
    check_by(Deadline::NONE, path, limits, &ReadOptions::default())
}

fn survey_for(
    purpose: Purpose,
    path: &Path,
    limits: &Limits,
    options: &SurveyOptions,
) -> Result<Survey, IngestError> {
    let tree = Tree::open(purpose, path, limits)?;
    let faults = tree.disk_faults();
    Ok(survey(tree, limits, options).map_err(|error| faults.or(error))?.1)
}

fn check_by(
    deadline: Deadline,
    path: &Path,
    limits: &Limits,
    reading: &ReadOptions,
) -> Result<DatasetSummary, IngestError> {
    // No pixel is decoded: the memory of a check has a bound that one photograph exceeds.
    let options = SurveyOptions { reading: reading.clone(), decode_bytes: 0, should_continue: &|| true };
    match survey_for(Purpose::Check(deadline), path, limits, &options) {
        Ok(survey) => Ok(survey.summary()),
        Err(error) if is_without_layout(&error) => unposed::check(deadline, path, limits, reading.max_width),
        Err(error) => Err(error),
    }
}

/// Whether files are in no dataset's layout.
fn is_without_layout(error: &IngestError) -> bool {
    matches!(error.kind, IngestErrorKind::NoLayout { .. })
}
