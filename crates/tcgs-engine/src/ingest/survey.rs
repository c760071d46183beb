//! Checks the plan of a dataset against its image headers and computes the final cameras.
//!
//! Pixels are decoded only to decide about EXIF orientations that sizes do not decide ([`super::orientation`]), and only within
//! [`SurveyOptions::decode_bytes`].

use std::{
    collections::BTreeMap,
    sync::{Arc, OnceLock},
};

use glam::DVec3;
use image::metadata::Orientation;

use super::{
    colmap,
    distortion::{Crop, Distortion},
    error::{IngestError, IngestErrorKind, Result},
    images::{self, DECODE_BYTES, Header},
    lens::{Lens, resized},
    limits::Limits,
    mask_pixels::Plane,
    mask_reader::{FrameMasks, MaskOptions, MaskReader},
    mask_search::find_masks,
    orientation::{Comparison, Decision, Evidence, EvidenceCounts, MAX_COMPARED, Reading, Unknown, evidence},
    plan::{Plan, PlannedFrame},
    points::Points,
    provenance, roots, transforms,
    tree::Tree,
    unused::{Taken, note_outside, note_unused},
    valid_region::{self, Kept},
};
use crate::domain::{
    Camera, DatasetSummary, HoldOut, Image, Intrinsics, Layout, NamedCamera, PixelMask, PointCloud,
    ReadOptions, Split, evenly_spaced::evenly_spaced,
};

/// Farthest camera from the origin that single precision can still work with.
const MAX_CAMERA_DISTANCE: f64 = 1e9;

/// Distance from the origin, in radii of the cameras' own extent, from which coordinates are noted as far out.
const FAR_OUT: f64 = 1000.0;

/// Distance in world units from which coordinates are those of a map or of the Earth, unless the cameras are as far apart.
const MAP_DISTANCE: f64 = 1e5;

/// How often a scene's radius fits into that distance at least.
const MAP_RADII: f64 = 20.0;

/// What a survey depends on besides the dataset.
pub(super) struct SurveyOptions<'a> {
    /// How files are read that may be read in more than one way.
    pub(super) reading: ReadOptions,
    /// The most memory for decoding an image whose orientation only pixels decide; none is decoded if it takes more.
    pub(super) decode_bytes: u64,
    /// Called before each image's header is read; once it returns false, the survey stops.
    pub(super) should_continue: &'a (dyn Fn() -> bool + Sync),
}

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

    /// Keeps at most `most` of the frames to train on, evenly along their order, and no others.
    pub(super) fn thin_out(&mut self, most: usize) {
        self.views.retain(|view| view.frame.split == Split::Train);
        let places: Vec<usize> = (0..self.views.len()).collect();
        let mut kept = evenly_spaced(&places, most).copied().peekable();
        let mut place = 0;
        self.views.retain(|_| {
            place += 1;
            kept.next_if_eq(&(place - 1)).is_some()
        });
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

/// The pixels that a lens saw, computed once they are wanted.
type ValidPixels = Arc<OnceLock<PixelMask>>;

/// A lens by its index, and the width and height of an image of it.
type LensAndSize = (usize, (u32, u32));

/// One frame and how its image is processed.
pub(super) struct SurveyedFrame {
    pub(super) frame: PlannedFrame,
    /// The camera of the finished image.
    pub(super) camera: Camera,
    /// How the stored pixels are turned first.
    pub(super) turn: Orientation,
    /// Pinhole intrinsics of the image so turned, distortion aside.
    stored: Intrinsics,
    /// Whether the stored image may be transparent.
    alpha: bool,
    distortion: Distortion,
    crop: Crop,
    /// The masks, and what they mean.
    pub(super) masks: FrameMasks,
    /// The pixels that the lens saw, computed once for all photographs of a camera and size; `None` if it saw all.
    valid: Option<ValidPixels>,
}

/// Bytes a pixel of an image in single precision, as the filter that downscales works on it.
const FILTER_BYTES: u64 = 16;

impl SurveyedFrame {
    /// The most memory that decoding and finishing the image takes, besides the stored file.
    pub(super) fn decode_bytes(&self) -> u64 {
        let (from, to) = (&self.stored, &self.camera.intrinsics);
        let pixels = |width: u32, height: u32| u64::from(width) * u64::from(height);
        let channels = if self.alpha || self.masks.cuts_out() { 4 } else { 3 };
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
        let masks = self.masks.decode_bytes(pixels(from.width, from.height), self.alpha);
        resampling.max(DECODE_BYTES * pixels(from.width, from.height)).saturating_add(masks)
    }

    /// Width and height of the stored and turned image.
    pub(super) fn stored_size(&self) -> (u32, u32) {
        (self.stored.width, self.stored.height)
    }

    /// Which pixels of the finished image count by a mask of the stored and turned one: those of which all that they show does.
    pub(super) fn finish_mask(&self, plane: Plane) -> Option<PixelMask> {
        let plane = if self.distortion.is_none() {
            plane
        } else {
            let image = plane.to_image()?;
            drop(plane);
            Plane::of_image(&self.distortion.undistort(&image, &self.stored, self.crop))
        };
        let finished = self.camera.intrinsics;
        plane.downscaled(finished.width, finished.height).mask()
    }

    /// The pixels of the finished image that the lens saw; `None` if it saw all.
    pub(super) fn valid_pixels(&self) -> Option<PixelMask> {
        let size = (self.camera.intrinsics.width, self.camera.intrinsics.height);
        let compute = || valid_region::valid_pixels(&self.distortion, &self.stored, size);
        self.valid.as_ref().map(|valid| valid.get_or_init(compute).clone())
    }

    /// The finished image from the stored and turned one.
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

/// Surveys the dataset in `tree`, which becomes the tree of its folder.
///
/// # Errors
/// The first error by the order of names.
pub(super) fn survey(
    mut tree: Tree,
    limits: &Limits,
    options: &SurveyOptions,
) -> Result<(Tree, Survey), IngestError> {
    let root = roots::find(&tree)?;
    let outside = if root.is_empty() { Vec::new() } else { tree.enter(&root) };
    let mut plan = plan(&tree, &options.reading)?;
    if options.reading.holdout == HoldOut::Sector {
        plan.hold_out_sector();
    }
    let masks = find_masks(&tree, &plan, &options.reading.masks)?;
    let Plan { layout, lenses, frames, points, listed, listings, mut noted, mut notes, .. } = plan;
    noted.extend(masks.of_frames.iter().flatten().cloned());
    notes.extend(provenance::note(&tree));
    let taken = Taken { listed: &listed, noted: &noted, listings: &listings };
    note_outside(&root, &outside, &mut notes);
    note_unused(&tree, &taken, &mut notes);

    let mut surveyor = Surveyor { lenses, kept: BTreeMap::new() };
    let headers = Headers::read(&tree, &frames, limits, options);
    let mut counts = EvidenceCounts::default();
    let evidence: Vec<Evidence> = frames
        .iter()
        .zip(&headers.read)
        .map(|(frame, header)| {
            evidence(header, &surveyor.lenses[frame.lens], options.reading.exif_orientation)
        })
        .inspect(|evidence| counts.count(*evidence))
        .collect();
    let decision = if counts.has_others() {
        let undecided = frames.iter().zip(&headers.read).zip(&evidence);
        let undecided = undecided.filter(|(_, evidence)| **evidence == Evidence::None).map(|(pair, _)| pair);
        let comparer = Comparer { tree: &tree, points: points.as_ref(), limits, options };
        Some(comparer.decide(&mut surveyor, &undecided.collect::<Vec<_>>(), &counts)?)
    } else {
        None
    };

    let mask_options = MaskOptions {
        mode: options.reading.mask_mode,
        decode_bytes: options.decode_bytes,
        should_continue: options.should_continue,
    };
    let mask_reader = MaskReader::new(&tree, &masks, limits, &mask_options)?;
    notes.extend(mask_reader.note(&masks, frames.len()));
    let mut views = Vec::with_capacity(frames.len());
    let mut changes = Changes::default();
    let mut pixels = 0;
    let mut with_alpha = 0;
    for (((frame, header), evidence), masks) in
        frames.into_iter().zip(&headers.read).zip(evidence).zip(masks.of_frames)
    {
        let reading = match evidence {
            Evidence::Upright => Reading::Stored,
            Evidence::Stated(reading) | Evidence::Size(reading) => reading,
            Evidence::None => decision.map_or(Reading::Stored, Decision::reading),
        };
        let stated = surveyor.lenses[frame.lens].size;
        tree.check_time().map_err(|error| error.at(&frame.file))?;
        let mut view = surveyor.view(frame, header, reading)?;
        view.masks = mask_reader.of_frame(masks, header, view.stored_size(), view.turn)?;
        with_alpha += usize::from(header.alpha);
        let finished = view.camera.intrinsics;
        changes.count(stated, &view);
        pixels += u64::from(finished.width) * u64::from(finished.height);
        if pixels > limits.scene_pixels {
            let error = IngestErrorKind::TooManyScenePixels { pixels, limit: limits.scene_pixels };
            return Err(error.at(view.frame.file));
        }
        views.push(view);
    }
    headers.end?;
    counts.note(decision, &mut notes);
    changes.note(&mut notes);
    notes.extend(mask_reader.alpha_note(layout, with_alpha));
    notes.extend(distance_note(&views));
    let point_count = points.as_ref().map(Points::count);
    let points = points.and_then(Points::into_cloud);
    Ok((tree, Survey { layout, views, points, point_count, notes }))
}

/// Headers of the frames' images up to the first error.
struct Headers {
    read: Vec<Header>,
    end: Result<(), IngestError>,
}

impl Headers {
    /// One after another: each is a small read, and several at a time would each need memory for a header.
    fn read(tree: &Tree, frames: &[PlannedFrame], limits: &Limits, options: &SurveyOptions) -> Self {
        let mut read = Vec::with_capacity(frames.len());
        let mut next = |frame: &PlannedFrame| -> Result<(), IngestError> {
            if !(options.should_continue)() {
                return Err(IngestErrorKind::Stopped.into());
            }
            tree.check_time().map_err(|error| error.at(&frame.file))?;
            read.push(images::header(tree, &frame.file, limits)?);
            Ok(())
        };
        let end = frames.iter().try_for_each(&mut next);
        Self { read, end }
    }
}

/// Computes the final camera of each frame.
struct Surveyor {
    lenses: Vec<Lens>,
    /// What is kept of images by lens and size, and the valid pixels where there are others.
    kept: BTreeMap<LensAndSize, (Crop, Option<ValidPixels>)>,
}

impl Surveyor {
    /// The frame with its image read this way.
    ///
    /// # Errors
    /// What is wrong with its camera, or with its image's size.
    fn view(
        &mut self,
        frame: PlannedFrame,
        header: &Header,
        reading: Reading,
    ) -> Result<SurveyedFrame, IngestError> {
        let size = reading.size(header);
        let lens = &self.lenses[frame.lens];
        let (file, distortion) = (frame.file.clone(), lens.distortion);
        let stored = lens.intrinsics(size).map_err(|error| error.at(&file))?;
        let (crop, valid) = match self.kept.get(&(frame.lens, size)) {
            Some(kept) => kept.clone(),
            None => {
                let Kept { crop, is_masked } =
                    valid_region::kept(&distortion, &stored).map_err(|error| error.at(&file))?;
                let kept = (crop, is_masked.then(Arc::default));
                self.kept.insert((frame.lens, size), kept.clone());
                kept
            }
        };
        let finished = for_training(crop.of(stored));
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
        let (turn, alpha) = (reading.turn(header), header.alpha);
        let masks = FrameMasks::default();
        Ok(SurveyedFrame { frame, camera, turn, stored, alpha, distortion, crop, masks, valid })
    }
}

/// Compares photographs with the points' colors.
struct Comparer<'a> {
    tree: &'a Tree,
    points: Option<&'a Points>,
    limits: &'a Limits,
    options: &'a SurveyOptions<'a>,
}

impl Comparer<'_> {
    /// How the photographs without evidence of their own are read.
    ///
    /// # Errors
    /// The deadline, and [`IngestErrorKind::Stopped`].
    fn decide(
        &self,
        surveyor: &mut Surveyor,
        undecided: &[(&PlannedFrame, &Header)],
        counts: &EvidenceCounts,
    ) -> Result<Decision, IngestError> {
        let otherwise = |unknown| counts.by_sizes().unwrap_or(Decision::Unknown(unknown));
        let Some(points) = self.points.filter(|points| points.has_colors()) else {
            return Ok(otherwise(Unknown::NoColors));
        };
        let Some(cloud) = points.cloud() else { return Ok(Decision::Unknown(Unknown::NotRead)) };
        if cloud.colors.windows(2).all(|pair| pair[0] == pair[1]) {
            return Ok(otherwise(Unknown::NoColors));
        }
        let mut comparison = Comparison::default();
        let step = undecided.len().div_ceil(MAX_COMPARED).max(1);
        for (frame, header) in undecided.iter().step_by(step) {
            if !(self.options.should_continue)() {
                return Err(IngestErrorKind::Stopped.into());
            }
            self.tree.check_time()?;
            let mut read = |reading| self.finished(surveyor.view((*frame).clone(), header, reading).ok()?);
            if let (Some((stored, from)), Some((turned, to))) = (read(Reading::Stored), read(Reading::Turned))
            {
                comparison.add(cloud, (&stored, &from), (&turned, &to));
            }
        }
        Ok(comparison.decision().unwrap_or_else(|| otherwise(Unknown::Alike)))
    }

    /// The camera and the pixels that training would have; `None` for an image that cannot be decoded, which loading reports, or not
    /// within the memory for it.
    fn finished(&self, view: SurveyedFrame) -> Option<(Camera, Image)> {
        let file = &view.frame.file;
        let needed = view.decode_bytes().saturating_add(self.tree.size(file).saturating_mul(2));
        if needed > self.options.decode_bytes {
            return None;
        }
        let bytes = self.tree.read(file).ok()?;
        let image =
            images::decode(&bytes, view.turn, self.limits).and_then(|image| view.finish(image)).ok()?;
        Some((view.camera, image))
    }
}

/// A note on coordinates as far from the origin as those of maps and of the whole Earth are: other programs read them in single
/// precision.
fn distance_note(views: &[SurveyedFrame]) -> Option<String> {
    let centers: Vec<DVec3> = views.iter().map(|view| view.frame.pose.center()).collect();
    let mean = centers.iter().sum::<DVec3>() / centers.len().max(1) as f64;
    let radius = centers.iter().map(|center| center.distance(mean)).fold(0.0, f64::max);
    let distance = mean.length();
    let radii = if distance >= MAP_DISTANCE { MAP_RADII } else { FAR_OUT };
    if radius == 0.0 || distance < radii * radius {
        return None;
    }
    // The distance between neighboring numbers of single precision.
    let step =
        f64::from((mean.abs().max_element() as f32).next_up()) - f64::from(mean.abs().max_element() as f32);
    // Zero without a sign.
    let DVec3 { x, y, z } = mean.round() + 0.0;
    Some(format!(
        "the cameras are {distance:.0} units from the origin, around ({x}, {y}, {z}), and within {radius:.3} of each other, as in UTM \
         or ECEF coordinates: training does not mind, but single precision has steps of {step} there, so exported files may be \
         relative to an offset, which they state"
    ))
}

/// The plan by whichever layout the files are in. `transforms.json` states its own cameras, so it takes precedence over a reconstruction
/// beside it; the Blender files also state the split, so they go first.
fn plan(tree: &Tree, read: &ReadOptions) -> Result<Plan, IngestError> {
    if tree.has(transforms::TRAIN) {
        return transforms::blender(tree, read);
    }
    if tree.has(transforms::TRANSFORMS) {
        return transforms::nerfstudio(tree, read);
    }
    let choice = colmap::detect(tree).ok_or(IngestErrorKind::NoLayout { photographs: 0, unread: None })?;
    colmap::plan(tree, choice, read)
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
    /// The largest angle from the axis, in degrees, of the pictures of lenses that may be wide.
    angle: Option<f64>,
    masked: usize,
    cropped: Option<((u32, u32), (u32, u32))>,
    downscaled: usize,
}

impl Changes {
    fn count(&mut self, stated: Option<(u32, u32)>, view: &SurveyedFrame) {
        let size = |k: &Intrinsics| (k.width, k.height);
        let (stored, crop) = (&view.stored, (view.crop.width, view.crop.height));
        self.smaller_than_stated += usize::from(stated.is_some_and(|stated| stated != size(stored)));
        self.undistorted += usize::from(!view.distortion.is_none());
        self.masked += usize::from(view.valid.is_some());
        if matches!(view.distortion, Distortion::Projection(_)) {
            let angle = corner_angle(&view.camera.intrinsics);
            self.angle = Some(self.angle.map_or(angle, |largest| largest.max(angle)));
        }
        if self.cropped.is_none() && size(stored) != crop {
            self.cropped = Some((size(stored), crop));
        }
        self.downscaled += usize::from(view.camera.intrinsics.width != view.crop.width);
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
            let angle = self.angle.map_or_else(String::new, |angle| {
                format!("; at the stated focal length, the corners are {angle:.0} degrees from the axis")
            });
            notes.push(format!("images undistorted: {}{crop}{angle}", self.undistorted));
        }
        if self.masked > 0 {
            notes.push(format!(
                "images with borders that the lens did not see: {}; these are neither learnt nor measured",
                self.masked
            ));
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

/// The angle of the farthest corner from the axis, in degrees.
fn corner_angle(k: &Intrinsics) -> f64 {
    let far = |center: f64, side: u32, focal: f64| center.abs().max((f64::from(side) - center).abs()) / focal;
    far(k.cx, k.width, k.fx).hypot(far(k.cy, k.height, k.fy)).atan().to_degrees()
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
