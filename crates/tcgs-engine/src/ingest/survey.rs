//! Checks the plan of a dataset against its image headers and computes the final cameras.
//!
//! Pixels are decoded only to decide about EXIF orientations that sizes do not decide ([`super::orientation`]), and only within
//! [`SurveyOptions::decode_bytes`].

use std::{collections::BTreeMap, sync::Arc};

use super::{
    colmap,
    distortion::Crop,
    error::{IngestError, IngestErrorKind, Result},
    images::{self, Header, is_image_name},
    lens::{Lens, resized},
    limits::Limits,
    mask_reader::{FrameMasks, MaskOptions, MaskReader},
    mask_search::find_masks,
    orientation::{Comparison, Decision, Evidence, EvidenceCounts, MAX_COMPARED, Reading, Unknown, evidence},
    plan::{Plan, PlannedFrame},
    points::Points,
    provenance, roots,
    survey_notes::{Changes, distance_note},
    surveyed_frame::{SurveyedFrame, ValidPixels},
    transforms,
    tree::Tree,
    unused::{Taken, note_outside, note_unused},
    valid_region::{self, Kept},
};
use crate::domain::{
    Camera, DatasetSummary, HoldOut, Image, Intrinsics, Layout, MaxWidth, NamedCamera, PointCloud,
    ReadOptions, Split, evenly_spaced::evenly_spaced,
};

/// Farthest camera from the origin that single precision can still work with.
const MAX_CAMERA_DISTANCE: f64 = 1e9;

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

/// A lens by its index, and the width and height of an image of it.
type LensAndSize = (usize, (u32, u32));

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
    let images_of = if root.is_empty() { None } else { tree.enter(&root, is_image_name) };
    let mut plan = plan(&tree, &options.reading)?;
    if options.reading.holdout == HoldOut::Sector {
        plan.hold_out_sector();
    }
    let masks = find_masks(&tree, &plan, &options.reading.masks)?;
    let Plan { layout, lenses, frames, points, listed, listings, mut noted, mut notes, .. } = plan;
    noted.extend(masks.of_frames.iter().flatten().cloned());
    notes.extend(provenance::note(&tree));
    let taken = Taken { listed: &listed, noted: &noted, listings: &listings };
    note_outside(&root, images_of.as_deref(), tree.outside(), &mut notes);
    note_unused(&tree, &taken, &mut notes);

    let mut surveyor = Surveyor { lenses, max_width: options.reading.max_width, kept: BTreeMap::new() };
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
    max_width: MaxWidth,
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
        let finished = for_training(crop.of(stored), self.max_width);
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

/// Intrinsics of the image as it is trained on: at most `widest` wide, the height rounded down.
fn for_training(k: Intrinsics, widest: MaxWidth) -> Intrinsics {
    let width = widest.pixels();
    if k.width <= width {
        return k;
    }
    let height = (u64::from(k.height) * u64::from(width) / u64::from(k.width)).max(1) as u32;
    resized(k, (k.width, k.height), (width, height))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wide_images_shrink_to_the_training_width_with_their_intrinsics() {
        let k = Intrinsics { fx: 3000.0, fy: 3100.0, cx: 1700.0, cy: 1000.0, width: 3201, height: 2133 };
        let small = for_training(k, MaxWidth::default());
        assert_eq!((small.width, small.height), (1600, 1066));
        let (x, y) = (1600.0 / 3201.0, 1066.0 / 2133.0);
        assert!((small.fx - 3000.0 * x).abs() < 1e-9 && (small.cx - 1700.0 * x).abs() < 1e-9);
        assert!((small.fy - 3100.0 * y).abs() < 1e-9 && (small.cy - 1000.0 * y).abs() < 1e-9);
        let narrow = Intrinsics { width: 1600, ..k };
        assert_eq!(for_training(narrow, MaxWidth::default()), narrow);
        let flat = Intrinsics { width: 16_000, height: 1, ..k };
        assert_eq!(for_training(flat, MaxWidth::default()).height, 1);
        let asked = MaxWidth::new(400).expect("a width");
        assert_eq!((for_training(k, asked).width, for_training(k, asked).height), (400, 266));
    }
}
