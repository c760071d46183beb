//! Checks the plan of a dataset against its image headers and computes the final cameras, without decoding a pixel.

use std::collections::BTreeMap;

use super::{
    colmap,
    distortion::{Crop, Distortion},
    error::{IngestError, IngestErrorKind, Result},
    images,
    lens::resized,
    limits::Limits,
    plan::{Plan, PlannedFrame, refuse_masks},
    points::Points,
    transforms,
    tree::Tree,
};
use crate::domain::{Camera, DatasetSummary, Image, Intrinsics, Layout, NamedCamera, PointCloud, Split};

/// Farthest camera from the origin that single precision can still work with.
const MAX_CAMERA_DISTANCE: f64 = 1e9;

/// A dataset of which only the pixels are unknown.
pub(super) struct Survey {
    pub(super) layout: Layout,
    /// By name.
    pub(super) views: Vec<SurveyedFrame>,
    /// The points, if they are kept.
    pub(super) points: Option<PointCloud>,
    /// How many there are, if the dataset has any.
    pub(super) point_count: Option<usize>,
    pub(super) notes: Vec<String>,
}

impl Survey {
    pub(super) fn summary(&self) -> DatasetSummary {
        let count = |split| self.views.iter().filter(|view| view.frame.split == split).count();
        let pixels = self.views.iter().map(|view| {
            let k = view.camera.intrinsics;
            u64::from(k.width) * u64::from(k.height)
        });
        DatasetSummary {
            layout: self.layout,
            train: count(Split::Train),
            test: count(Split::Test),
            pixels: pixels.sum(),
            points: self.point_count,
            notes: self.notes.clone(),
        }
    }

    /// The cameras of the frames, in their order.
    pub(super) fn into_cameras(self) -> Vec<NamedCamera> {
        let camera = |SurveyedFrame { frame, camera, .. }| NamedCamera {
            name: frame.name,
            split: frame.split,
            camera,
        };
        self.views.into_iter().map(camera).collect()
    }
}

/// One frame and how its image is processed.
pub(super) struct SurveyedFrame {
    pub(super) frame: PlannedFrame,
    /// The camera of the finished image.
    pub(super) camera: Camera,
    /// Pinhole intrinsics of the stored image, distortion aside.
    stored: Intrinsics,
    /// Whether the stored image may be transparent.
    alpha: bool,
    distortion: Distortion,
    crop: Crop,
}

/// Bytes a pixel of the stored image that decoding takes at most: 16-bit RGBA beside its 8-bit copy, or 8-bit RGB beside what a
/// progressive JPEG keeps.
const DECODE_BYTES: u64 = 12;
/// Bytes a pixel of an image in single precision, as the filter that downscales works on it.
const FILTER_BYTES: u64 = 16;

impl SurveyedFrame {
    /// The most memory that decoding and finishing the image takes, besides the stored file.
    pub(super) fn decode_bytes(&self) -> u64 {
        let (from, to) = (&self.stored, &self.camera.intrinsics);
        let pixels = |width: u32, height: u32| u64::from(width) * u64::from(height);
        let channels = if self.alpha { 4 } else { 3 };
        // As stored, undistorted, weighted by alpha; then filtered down, then across.
        let mut resampling = channels * pixels(from.width, from.height);
        if !self.distortion.is_none() {
            resampling += channels * pixels(from.width, from.height);
        }
        if self.crop.width != to.width {
            let weighted =
                if self.alpha { FILTER_BYTES * pixels(self.crop.width, self.crop.height) } else { 0 };
            resampling += weighted
                + FILTER_BYTES * pixels(self.crop.width, to.height)
                + (FILTER_BYTES + channels) * pixels(to.width, to.height);
        }
        resampling.max(DECODE_BYTES * pixels(from.width, from.height))
    }

    /// The finished image from the stored one.
    ///
    /// # Errors
    /// [`IngestErrorKind::Image`] if the pixels are not of the size that the header promised.
    pub(super) fn finish(&self, image: Image) -> Result<Image> {
        let (actual, expected) = ((image.width(), image.height()), (self.stored.width, self.stored.height));
        if actual != expected {
            return Err(IngestErrorKind::Image(format!(
                "the header says {expected:?} pixels and the data {actual:?}"
            )));
        }
        let image = if self.distortion.is_none() {
            image
        } else {
            self.distortion.undistort(&image, &self.stored, self.crop)
        };
        let finished = self.camera.intrinsics;
        Ok(if image.width() == finished.width {
            image
        } else {
            super::sampling::downscaled(image, finished.width, finished.height)
        })
    }
}

/// Surveys the dataset in `tree`, whose root may be its only top-level folder.
///
/// # Errors
/// The first error by the order of names.
pub(super) fn survey(
    mut tree: Tree,
    limits: &Limits,
    should_continue: &(dyn Fn() -> bool + Sync),
) -> Result<(Tree, Survey), IngestError> {
    let plan = match plan(&tree) {
        None if tree.enter_only_folder() => plan(&tree),
        plan => plan,
    }
    .ok_or(IngestErrorKind::NoLayout)??;
    refuse_masks(&tree)?;
    let Plan { layout, lenses, frames, points, mut notes } = plan;

    let mut crops = BTreeMap::new();
    let mut views = Vec::with_capacity(frames.len());
    let mut changes = Changes::default();
    let mut pixels = 0;
    // One after another: each is a small read, and several at a time would each need memory for a header.
    for frame in frames {
        if !should_continue() {
            return Err(IngestErrorKind::Stopped.into());
        }
        tree.check_time().map_err(|error| error.at(&frame.file))?;
        let images::Header { size, alpha } = images::header(&tree, &frame.file, limits)?;
        let lens = &lenses[frame.lens];
        let (file, distortion) = (frame.file.clone(), lens.distortion);
        let stored = lens.intrinsics(size).map_err(|error| error.at(&file))?;
        let crop = match crops.get(&(frame.lens, size)) {
            Some(crop) => *crop,
            None => {
                let crop = distortion.covered(&stored).map_err(|error| error.at(&file))?;
                crops.insert((frame.lens, size), crop);
                crop
            }
        };
        let cropped = crop.of(stored);
        let finished = for_training(cropped);
        let camera = Camera::new(finished, frame.pose)
            .map_err(|source| IngestErrorKind::Camera { place: frame.name.clone(), source }.at(&file))?;
        let distance = frame.pose.center().abs().max_element();
        if distance > MAX_CAMERA_DISTANCE {
            let range = "at most 1e9 units from the origin";
            return Err(IngestErrorKind::Implausible {
                what: "the camera's position",
                value: distance,
                range,
            }
            .at(file));
        }
        changes.count(lens.size, &stored, &distortion, &cropped, &finished);
        pixels += u64::from(finished.width) * u64::from(finished.height);
        if pixels > limits.scene_pixels {
            return Err(IngestErrorKind::TooManyScenePixels { pixels, limit: limits.scene_pixels }.at(file));
        }
        views.push(SurveyedFrame { frame, camera, stored, alpha, distortion, crop });
    }
    changes.note(&mut notes);
    let point_count = points.as_ref().map(Points::count);
    let points = points.and_then(Points::into_cloud);
    Ok((tree, Survey { layout, views, points, point_count, notes }))
}

/// The plan by whichever layout the files are in; `None` if in none. `transforms.json` states its own cameras, so
/// it takes precedence over a reconstruction beside it; the Blender files also state the split, so they go first.
fn plan(tree: &Tree) -> Option<Result<Plan, IngestError>> {
    if tree.has(transforms::TRAIN) {
        return Some(transforms::blender(tree));
    }
    if tree.has(transforms::TRANSFORMS) {
        return Some(transforms::nerfstudio(tree));
    }
    colmap::detect(tree).map(|model| colmap::plan(tree, model))
}

/// Intrinsics of the image as it is trained on: at most [`Limits::TRAINING_WIDTH`] wide, the height rounded down.
fn for_training(k: Intrinsics) -> Intrinsics {
    let width = Limits::TRAINING_WIDTH;
    if k.width <= width {
        return k;
    }
    let height = (u64::from(k.height) * u64::from(width) / u64::from(k.width)).max(1) as u32;
    resized(k, (k.width, k.height), (width, height))
}

/// How many images were changed and how, for the notes.
#[derive(Default)]
struct Changes {
    smaller_than_stated: usize,
    undistorted: usize,
    cropped: Option<((u32, u32), (u32, u32))>,
    downscaled: usize,
}

impl Changes {
    fn count(
        &mut self,
        stated: Option<(u32, u32)>,
        stored: &Intrinsics,
        distortion: &Distortion,
        cropped: &Intrinsics,
        finished: &Intrinsics,
    ) {
        let size = |k: &Intrinsics| (k.width, k.height);
        self.smaller_than_stated += usize::from(stated.is_some_and(|stated| stated != size(stored)));
        self.undistorted += usize::from(!distortion.is_none());
        if self.cropped.is_none() && size(stored) != size(cropped) {
            self.cropped = Some((size(stored), size(cropped)));
        }
        self.downscaled += usize::from(finished.width != cropped.width);
    }

    fn note(&self, notes: &mut Vec<String>) {
        if self.smaller_than_stated > 0 {
            notes.push(format!(
                "images smaller than their camera states: {}; the intrinsics were scaled to them",
                self.smaller_than_stated
            ));
        }
        if self.undistorted > 0 {
            let crop = self.cropped.map_or_else(String::new, |((w, h), (to_w, to_h))| {
                format!(", cropped to what the lens saw ({w}x{h} to {to_w}x{to_h})")
            });
            notes.push(format!("images undistorted: {}{crop}", self.undistorted));
        }
        if self.downscaled > 0 {
            notes.push(format!(
                "images wider than {} pixels, downscaled to that width: {}",
                Limits::TRAINING_WIDTH,
                self.downscaled
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wide_images_shrink_to_the_training_width_with_their_intrinsics() {
        let k = Intrinsics { fx: 3000.0, fy: 3100.0, cx: 1700.0, cy: 1000.0, width: 3201, height: 2133 };
        let small = for_training(k);
        assert_eq!((small.width, small.height), (1600, 1066));
        let (x, y) = (1600.0 / 3201.0, 1066.0 / 2133.0);
        assert!((small.fx - 3000.0 * x).abs() < 1e-9 && (small.cx - 1700.0 * x).abs() < 1e-9);
        assert!((small.fy - 3100.0 * y).abs() < 1e-9 && (small.cy - 1000.0 * y).abs() < 1e-9);
        let narrow = Intrinsics { width: 1600, ..k };
        assert_eq!(for_training(narrow), narrow);
        let flat = Intrinsics { width: 16_000, height: 1, ..k };
        assert_eq!(for_training(flat).height, 1);
    }
}
