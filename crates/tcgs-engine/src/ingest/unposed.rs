//! Photographs, or a video, that no file says the cameras of: a dataset once `poses` has found them.
//!
//! A folder or archive is one if no layout of a dataset is found in it. The check reads headers alone, within the limits of datasets.

use std::{
    collections::BTreeSet,
    fs::{self, File},
    io,
    path::Path,
    slice,
};

use super::{
    deadline::Deadline,
    error::{IngestError, IngestErrorKind},
    formats,
    images::{self, is_image_name},
    limits::Limits,
    masks::{is_mask_folder, name_of, stem_of},
    plan::folder_of,
    tree::{Purpose, Tree},
    video::{SIGNATURE_BYTES, is_video, is_video_name},
};
use crate::domain::{DatasetSummary, Layout, MaskSource, MaxWidth};

/// Names of COLMAP's tables, without extension.
const TABLES: [&str; 2] = ["cameras", "images"];

/// What cameras are found of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Unposed {
    /// Photographs.
    Photographs {
        /// Their names, in order.
        names: Vec<String>,
        /// Images in folders of masks.
        masks: Vec<String>,
    },
    /// A video, by its name.
    Video(String),
}

impl Unposed {
    /// The photographs below a folder or in an archive, hidden ones aside, or its video if it has no photographs; `path` may be a video too.
    ///
    /// # Errors
    /// Files that cannot be read or are too many, neither photographs nor a video, several videos.
    pub fn find(path: &Path) -> Result<Self, IngestError> {
        Self::of(&Tree::open(Purpose::Load, path, &Limits::default())?)
    }

    fn of(tree: &Tree) -> Result<Self, IngestError> {
        let is_hidden = |name: &str| name.split('/').any(|part| part.starts_with('.'));
        let shown = || tree.names().filter(|name| !is_hidden(name));
        let images: Vec<String> = shown().filter(|name| is_image_name(name)).map(str::to_owned).collect();
        // A folder of all images, as an archive has at its top, tells none of them from the others.
        let common = images.iter().fold(images.first().map(|name| folder_of(name)), |common, name| {
            common.map(|common| shared_folder(common, folder_of(name)))
        });
        let common = common.unwrap_or_default().len();
        let is_mask = |name: &String| folder_of(name)[common..].split('/').any(is_mask_folder);
        let (masks, names): (Vec<String>, Vec<String>) = images.iter().cloned().partition(is_mask);
        expect_read(shown(), &names)?;
        if !names.is_empty() {
            return Ok(Self::Photographs { names, masks });
        }
        let mut videos = shown().filter(|name| is_video_name(name));
        match (videos.next(), videos.next()) {
            (Some(video), None) => Ok(Self::Video(video.to_owned())),
            (Some(_), Some(second)) => Err(IngestErrorKind::SeveralVideos.at(second)),
            (None, _) => Err(IngestErrorKind::NoLayout { photographs: 0, unread: None }.into()),
        }
    }

    /// With the images in the folder that is named for masks among its masks.
    #[must_use]
    pub fn with_masks(self, source: &MaskSource) -> Self {
        match (self, source) {
            (Self::Photographs { names, mut masks }, MaskSource::Folder(folder)) => {
                let folder = format!("{}/", folder.trim_end_matches('/').trim_start_matches("./"));
                let (named, names) = names.into_iter().partition(|name| name.starts_with(&folder));
                masks.extend::<Vec<String>>(named);
                Self::Photographs { names, masks }
            }
            (other, _) => other,
        }
    }

    /// Writes the files into the folder `to`, by their names. `should_continue` is asked before each of them.
    ///
    /// # Errors
    /// Files that cannot be read, are too large, or cannot be written; [`IngestErrorKind::Stopped`].
    pub fn extract(
        &self,
        path: &Path,
        to: &Path,
        should_continue: &dyn Fn() -> bool,
    ) -> Result<(), IngestError> {
        let tree = Tree::open(Purpose::Load, path, &Limits::default())?;
        let (names, masks) = match self {
            Self::Photographs { names, masks } => (names.as_slice(), masks.as_slice()),
            Self::Video(name) => (slice::from_ref(name), &[][..]),
        };
        for name in names.iter().chain(masks) {
            if !should_continue() {
                return Err(IngestErrorKind::Stopped.into());
            }
            let copied = tree.parse_unused(name, u64::MAX, |reader, _| {
                let file = to.join(name);
                let written = (|| -> io::Result<()> {
                    fs::create_dir_all(file.parent().unwrap_or(to))?;
                    io::copy(reader, &mut File::create(&file)?).map(drop)
                })();
                written.map_err(IngestErrorKind::Write)
            });
            copied?;
        }
        Ok(())
    }

    /// The name of the kind.
    fn layout(&self) -> Layout {
        match self {
            Self::Photographs { .. } => Layout::Photographs,
            Self::Video(_) => Layout::Video,
        }
    }
}

/// The folder that has both folders in it, or is one of them.
fn shared_folder<'a>(a: &'a str, b: &str) -> &'a str {
    let same = a.split('/').zip(b.split('/')).take_while(|(a, b)| a == b);
    let length: usize = same.map(|(part, _)| part.len() + 1).sum();
    &a[..length.saturating_sub(1).min(a.len())]
}

/// Refuses photographs in a format that is not read, unless the same photograph lies beside them in one that is.
///
/// # Errors
/// [`IngestErrorKind::UnreadFormat`].
fn expect_read<'a>(files: impl Iterator<Item = &'a str>, photographs: &[String]) -> Result<(), IngestError> {
    let read: BTreeSet<&str> = photographs.iter().map(|name| stem_of(name)).collect();
    for name in files {
        let format = formats::by_name(name).filter(|format| format.is_of_cameras());
        if let Some(format) = format.filter(|_| !read.contains(stem_of(name))) {
            let remedy = format.remedy(name);
            return Err(IngestErrorKind::UnreadFormat { format: format.name, remedy }.at(name));
        }
    }
    Ok(())
}

/// Whether a file is a table of cameras: then the files are a dataset in the wrong place, or several.
fn is_table(name: &str) -> bool {
    let name = name_of(name).to_lowercase();
    let is_transforms = name.starts_with("transforms") && name.ends_with(".json");
    is_transforms
        || TABLES.iter().any(|table| name == format!("{table}.txt") || name == format!("{table}.bin"))
}

/// Checks photographs or a video without cameras.
///
/// # Errors
/// [`IngestErrorKind::TooFewPhotographs`], [`IngestErrorKind::NotAVideo`]; else as the check of a dataset.
pub(super) fn check(
    deadline: Deadline,
    path: &Path,
    limits: &Limits,
    max_width: MaxWidth,
) -> Result<DatasetSummary, IngestError> {
    let tree = Tree::open(Purpose::Check(deadline), path, limits)?;
    let faults = tree.disk_faults();
    summary(&tree, limits, max_width).map_err(|error| faults.or(error))
}

fn summary(tree: &Tree, limits: &Limits, max_width: MaxWidth) -> Result<DatasetSummary, IngestError> {
    if tree.names().any(is_table) {
        let photographs = tree.names().filter(|name| is_image_name(name)).count();
        return Err(IngestErrorKind::NoLayout { photographs, unread: None }.into());
    }
    let unposed = Unposed::of(tree)?;
    let (mut pixels, mut count) = (0, 0);
    match &unposed {
        Unposed::Photographs { names, masks } => {
            for name in masks {
                tree.check_time().map_err(|error| error.at(name))?;
                images::header(tree, name, limits)?;
            }
            if names.len() < Limits::MIN_PHOTOGRAPHS {
                return Err(IngestErrorKind::TooFewPhotographs(names.len()).into());
            }
            if names.len() > Limits::FRAMES {
                let (count, limit) = (names.len(), Limits::FRAMES);
                return Err(IngestErrorKind::TooManyPhotographs { count, limit }.into());
            }
            for name in names {
                tree.check_time().map_err(|error| error.at(name))?;
                let (width, height) = images::header(tree, name, limits)?.size;
                let trained = width.min(max_width.pixels());
                pixels += u64::from(trained) * u64::from(height) * u64::from(trained) / u64::from(width);
                if pixels > limits.scene_pixels {
                    let error = IngestErrorKind::TooManyScenePixels { pixels, limit: limits.scene_pixels };
                    return Err(error.at(name));
                }
            }
            count = names.len();
        }
        Unposed::Video(name) => {
            if !is_video(&tree.read_up_to(name, SIGNATURE_BYTES)?) {
                return Err(IngestErrorKind::NotAVideo.at(name));
            }
        }
    }
    let notes = vec![match &unposed {
        Unposed::Photographs { .. } => {
            "no file says the cameras of the photographs: a job finds them first".to_owned()
        }
        Unposed::Video(name) => {
            format!("a job takes photographs from the video {name}, and finds their cameras")
        }
    }];
    Ok(DatasetSummary { layout: unposed.layout(), train: count, test: 0, pixels, points: None, notes })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Problem, ProblemType, ReadOptions};

    fn put(folder: &Path, name: &str, content: &[u8]) {
        let path = folder.join(name);
        fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
        fs::write(path, content).expect("a file");
    }

    fn photograph(width: u32) -> Vec<u8> {
        let mut bytes = io::Cursor::new(Vec::new());
        let image = image::RgbImage::from_pixel(width, 2, image::Rgb([7; 3]));
        image.write_to(&mut bytes, image::ImageFormat::Png).expect("encodes");
        bytes.into_inner()
    }

    #[test]
    fn photographs_of_all_folders_are_found_and_nothing_else_is() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in
            ["b.JPG", "a/c.png", "a/d.webp", "notes.txt", ".hidden/e.jpg", "__MACOSX/._b.JPG", "v.mp4"]
        {
            put(folder.path(), name, b"");
        }
        let Unposed::Photographs { names: found, .. } = Unposed::find(folder.path()).expect("readable")
        else {
            panic!("no photographs")
        };
        assert_eq!(found, ["a/c.png", "a/d.webp", "b.JPG"]);
        assert!(Unposed::find(&folder.path().join("missing")).is_err());
        put(folder.path(), "masks/b.png", b"");
        put(folder.path(), "b.HEIC", b"");
        let Unposed::Photographs { names, masks } = Unposed::find(folder.path()).expect("converted beside")
        else {
            panic!("no photographs")
        };
        assert_eq!((names.len(), masks), (3, vec!["masks/b.png".to_owned()]));
        put(folder.path(), "e.heic", b"");
        let problem = Problem::from(Unposed::find(folder.path()).expect_err("not read"));
        assert!(problem.detail.contains("`mogrify -format "), "{problem}");
    }

    #[test]
    fn a_folder_of_all_images_is_none_of_masks_whatever_its_name() {
        let found = |names: &[&str]| {
            let folder = tempfile::tempdir().expect("a folder");
            names.iter().for_each(|name| put(folder.path(), name, &photograph(4)));
            let found = Unposed::find(folder.path()).expect("readable");
            let written = found.write_masks(folder.path(), &MaskSource::Auto, folder.path(), &|| true);
            let Unposed::Photographs { names, masks } = found else { panic!("no photographs") };
            (names.len(), masks, written.expect("masks"))
        };
        assert_eq!(found(&["matte/1.png", "matte/2.png", "matte/3.png"]), (3, Vec::new(), 0));
        assert_eq!(found(&["seg/a/1.png", "seg/b/1.png"]), (2, Vec::new(), 0));
        let masked = ["death mask/a/1.png", "death mask/a/2.png", "death mask/masks/1.png"];
        assert_eq!(found(&masked), (2, vec!["death mask/masks/1.png".to_owned()], 1));
        assert_eq!(found(&["1.png", "masks/1.png"]), (1, vec!["masks/1.png".to_owned()], 1));
    }

    #[test]
    fn a_dataset_without_cameras_is_told_from_what_is_wrong_with_photographs() {
        let folder = tempfile::tempdir().expect("a folder");
        let lacks = || super::super::lacks_cameras(folder.path(), &ReadOptions::default());
        assert_eq!(lacks(), Ok(false), "loading says that there is nothing");
        for name in ["1.png", "2.png"] {
            put(folder.path(), name, &photograph(4));
        }
        let refused = lacks().expect_err("two photographs");
        assert!(refused.is(ProblemType::TooFewPhotographs), "{refused}");
        put(folder.path(), "3.png", &photograph(4));
        assert_eq!(lacks(), Ok(true));
        put(folder.path(), "4.heic", b"");
        assert_eq!(lacks().expect_err("not read").file.as_deref(), Some("4.heic"));
        put(folder.path(), "transforms.json", b"{");
        assert_eq!(lacks(), Ok(false), "what is wrong with a dataset is left to who loads it");
    }

    #[test]
    fn photographs_are_checked_by_their_headers_and_extracted_as_they_are() {
        let folder = tempfile::tempdir().expect("a folder");
        let given = folder.path().join("given");
        for (number, width) in [(1, 4), (2, 3200)] {
            put(&given, &format!("DCIM/{number}.png"), &photograph(width));
        }
        let check = || super::super::check(&given);
        let refused = check().expect_err("two photographs");
        assert!(refused.is(ProblemType::TooFewPhotographs), "{refused}");
        put(&given, "DCIM/3.png", &photograph(4));
        let summary = check().expect("photographs");
        assert_eq!((summary.layout, summary.train, summary.pixels), (Layout::Photographs, 3, 8 + 1600 + 8));
        assert!(super::super::load(&given).is_err(), "there is nothing to train on yet");
        put(&given, "DCIM/4.png", b"\x89PNG\r\n\x1a\n no header");
        assert_eq!(check().expect_err("no photograph").file.as_deref(), Some("DCIM/4.png"));

        let to = folder.path().join("to");
        let unposed = Unposed::find(&given).expect("photographs");
        let stopped = unposed.extract(&given, &to, &|| false).expect_err("stopped");
        assert!(matches!(stopped.kind, IngestErrorKind::Stopped) && !to.exists());
        unposed.extract(&given, &to, &|| true).expect("extracted");
        assert_eq!(fs::read(to.join("DCIM/1.png")).expect("there"), photograph(4));
    }

    #[test]
    fn one_video_without_photographs_is_accepted_if_it_is_one() {
        let folder = tempfile::tempdir().expect("a folder");
        let check = || super::super::check(folder.path());
        put(folder.path(), "take/IMG_1.MOV", b"\0\0\0\x14ftypqt  ");
        let summary = check().expect("a video");
        assert_eq!((summary.layout, summary.train), (Layout::Video, 0));
        put(folder.path(), "b.mp4", b"\0\0\0\x14ftypisom");
        assert_eq!(check().expect_err("two videos").file.as_deref(), Some("take/IMG_1.MOV"));
        fs::remove_dir_all(folder.path().join("take")).expect("removed");
        put(folder.path(), "b.mp4", b"<html><body>");
        assert!(check().expect_err("no video").detail.contains("MP4"));
        put(folder.path(), "b.mp4", b"");
        assert!(check().is_err());
        // The file alone is accepted too, also under another name.
        for name in ["alone.m4v", "blob"] {
            put(folder.path(), name, b"\0\0\0\x14ftypisom");
            let alone = super::super::check(&folder.path().join(name)).expect("a video");
            assert_eq!(alone.layout, Layout::Video);
        }
    }
}
