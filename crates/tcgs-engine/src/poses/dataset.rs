//! Makes a dataset of photographs or of a video: the registered photographs and the model in COLMAP's layout, with a record of how its
//! cameras were found.
//!
//! Everything is written below one folder of the caller's. A photograph with a camera is a link to the file that was given, where the
//! file system can link it, else a copy.

use std::{
    fs, io,
    path::{Path, PathBuf},
    time::Instant,
};

use super::{
    PoseEstimator, PoseOptions, PoseProgress, PoseReport, PoseStage, PosesError,
    child::MASKS,
    frames::{Caller, Video},
    keep_alive::while_reporting,
    natural_order,
};
use crate::{
    domain::{CancelFlag, MaskSource},
    ingest::{IngestError, IngestErrorKind, POSES_RECORD, Unposed},
};

/// Photographs whose cameras were found.
#[derive(Debug)]
pub struct PosedDataset {
    /// What was found.
    pub report: PoseReport,
    /// The folder of the dataset.
    pub folder: PathBuf,
}

impl PoseEstimator {
    /// Finds the cameras of the photographs, or of frames of the video. The dataset is written below `work`, a folder that is empty, or
    /// that an interrupted call for the same photographs left: features and matches that it had are used again.
    ///
    /// # Errors
    /// Why there are no photographs, or their cameras were not found.
    pub fn dataset(
        &self,
        given: Given<'_>,
        work: &Path,
        mut options: PoseOptions,
        report: &mut dyn FnMut(PoseProgress),
        cancel: &CancelFlag,
    ) -> Result<PosedDataset, PosesError> {
        let [source, search, folder] = ["source", SEARCH_FOLDER, "dataset"].map(|name| work.join(name));
        let io = |what| move |error| PosesError::Io { what, error };
        let frames = work.join("frames");
        for left in [&source, &folder, &frames] {
            remove(left).map_err(io("cannot clear the folder to work in"))?;
        }
        fs::create_dir_all(&search).map_err(io("cannot create a folder to work in"))?;
        let Given { path: given, masks: mask_source } = given;
        let unposed = Unposed::find(given)?.with_masks(mask_source);
        let masks = work.join(MASKS);
        remove(&masks).map_err(io("cannot clear the folder to work in"))?;
        let end = Instant::now() + self.limits.time;
        let should_continue = || !cancel.is_cancelled() && Instant::now() < end;
        let (stage, total) = match &unposed {
            Unposed::Photographs { names, .. } => (PoseStage::Features, names.len()),
            Unposed::Video(_) => (PoseStage::Frames, options.frames),
        };
        let to_come = PoseProgress { stage, done: 0, total: total as u64, reprojection_error: None };
        let is_copied = !(given.is_dir() && matches!(unposed, Unposed::Photographs { .. }));
        while_reporting(to_come, report, || {
            unposed.write_masks(given, mask_source, &masks, &should_continue)?;
            if is_copied {
                unposed.extract(given, &source, &should_continue)?;
            }
            Ok(())
        })
        .map_err(|error: IngestError| match error.kind {
            IngestErrorKind::Stopped if cancel.is_cancelled() => PosesError::Cancelled,
            IngestErrorKind::Stopped => PosesError::TimedOut(self.limits.time),
            _ => error.into(),
        })?;
        let mut kept = Vec::new();
        let photographs = match unposed {
            Unposed::Photographs { names, masks } => {
                let folder = if is_copied { source } else { given.to_owned() };
                kept = masks.into_iter().map(|name| (folder.join(&name), name)).collect();
                Photographs { folder, names }
            }
            Unposed::Video(name) => {
                options.matching = options.matching.of_a_video();
                let video = Video {
                    ffmpeg: &self.ffmpeg,
                    path: &source.join(name),
                    limits: self.limits,
                    threads: options.threads,
                };
                let names = video.frames(&frames, options.frames, &mut Caller { report, cancel })?;
                Photographs { folder: frames, names }
            }
        };
        let root = photographs.folder.clone();
        let Photographs { folder: photographs, mut names } = photographs.in_their_folder();
        // By the same names as the photographs.
        let masks = masks.join(photographs.strip_prefix(&root).unwrap_or(Path::new("")));
        remove(&search.join(MASKS)).map_err(io("cannot clear the folder to work in"))?;
        if masks.is_dir() {
            fs::rename(&masks, search.join(MASKS)).map_err(io("cannot move the masks"))?;
        }
        names.sort_by(|a, b| natural_order(a, b));
        let found = self.estimate(&photographs, &names, &search, options, report, cancel)?;
        while_reporting(found.progress(), report, || assemble(&folder, &photographs, &found, &kept))
            .map_err(io("cannot write the dataset"))?;
        Ok(PosedDataset { report: found, folder })
    }
}

/// The folder of features and matches, in that of a dataset's search.
pub const SEARCH_FOLDER: &str = "search";

/// What cameras are found of.
#[derive(Debug, Clone, Copy)]
pub struct Given<'a> {
    /// A folder or a zip archive of photographs, or a video.
    pub path: &'a Path,
    /// Where masks are that hide what cameras must not be placed by.
    pub masks: &'a MaskSource,
}

/// Removes a folder, if it is there.
fn remove(folder: &Path) -> io::Result<()> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// Photographs by their names below a folder.
struct Photographs {
    folder: PathBuf,
    names: Vec<String>,
}

impl Photographs {
    /// The same photographs by their names below the deepest folder that has them all.
    fn in_their_folder(self) -> Self {
        let Self { mut folder, mut names } = self;
        while let Some((first, _)) = names.first().and_then(|name| name.split_once('/')) {
            let prefix = format!("{first}/");
            if !names.iter().all(|name| name.starts_with(&prefix)) {
                break;
            }
            folder.push(first);
            names.iter_mut().for_each(|name| *name = name[prefix.len()..].to_owned());
        }
        Self { folder, names }
    }
}

/// Puts the registered photographs and the model into a folder, in COLMAP's layout, and masks where they were.
fn assemble(
    dataset: &Path,
    photographs: &Path,
    found: &PoseReport,
    masks: &[(PathBuf, String)],
) -> io::Result<()> {
    let put = |from: &Path, to: &Path| -> io::Result<()> {
        fs::create_dir_all(to.parent().unwrap_or(dataset))?;
        if fs::hard_link(from, to).is_err() {
            fs::copy(from, to)?;
        }
        Ok(())
    };
    for name in &found.registered {
        put(&photographs.join(name), &dataset.join("images").join(name))?;
    }
    for (file, name) in masks {
        put(file, &dataset.join(name))?;
    }
    fs::create_dir_all(dataset.join("sparse"))?;
    fs::rename(&found.model, dataset.join("sparse/0"))?;
    fs::write(dataset.join(POSES_RECORD), serde_json::to_vec_pretty(found)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photographs_in_one_folder_have_names_below_it() {
        let below = |names: &[&str]| {
            let names = names.iter().map(|name| (*name).to_owned()).collect();
            let Photographs { folder, names } =
                Photographs { folder: PathBuf::from("given"), names }.in_their_folder();
            (folder.display().to_string(), names)
        };
        let names = |names: [&str; 2]| names.map(str::to_owned).to_vec();
        assert_eq!(
            below(&["take/images/a.jpg", "take/images/left/b.jpg"]),
            ("given/take/images".to_owned(), names(["a.jpg", "left/b.jpg"]))
        );
        assert_eq!(below(&["a/c.png", "b.png"]), ("given".to_owned(), names(["a/c.png", "b.png"])));
    }
}
