//! `transforms.json` (nerfstudio, instant-ngp) and `transforms_{train,val,test}.json` (Blender, NeRF-synthetic).
//!
//! Both are the same kind of file: camera-to-world matrices with OpenGL axes, and intrinsics stated once or for each frame.
//!
//! `applied_transform` is the motion that a converter applied to the reconstruction before it wrote the poses. The
//! poses and the points of `ply_file_path` are both written after it, so they already agree and it is not
//! applied again: scenes are trained, and views asked for, in the frame that the file's poses are in.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use glam::{DMat4, DVec4};

use super::{
    bounded_json,
    distortion::{Distortion, Polynomial},
    error::{IngestError, IngestErrorKind, Result},
    fields::{CameraFields, Document, MaskField, Matrix, Names, Parameters},
    image_files::{FoundImage, ImageFiles, ImageSearch},
    lens::{Focal, Lens},
    names::{normalized, portable, safe_name},
    plan::{Plan, PlannedFrame, StatedMask},
    ply,
    projection::Projection,
    tree::Tree,
};
use crate::domain::{Convention, Layout, Pose, ReadOptions, Split};

/// The nerfstudio and instant-ngp file.
pub(super) const TRANSFORMS: &str = "transforms.json";
/// The Blender file of the training split.
pub(super) const TRAIN: &str = "transforms_train.json";
const TEST: &str = "transforms_test.json";
/// A point cloud that programs for Blender sets look for without its being named.
const POINTS: &str = "points3d.ply";
const VALIDATION: &str = "transforms_val.json";

/// What a side may differ by from a whole number of pixels.
const WHOLE: f64 = 1e-6;

/// Scales of a rotation that are taken out of it.
const SCALES: std::ops::RangeInclusive<f64> = 1e-6..=1e6;

/// Camera models whose distortion is a polynomial of k1 to k4 and tangential.
const POLYNOMIAL_MODELS: [&str; 5] = ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"];

/// Camera models of pictures that no perspective one can show as a whole.
const PANORAMAS: [&str; 5] =
    ["EQUIRECTANGULAR", "OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R", "VR180_L", "VR180_R"];

/// Plans a Blender set: `transforms_train.json` is trained on and `transforms_test.json` held out.
///
/// # Errors
/// Everything that is wrong with the files or the images they list.
pub(super) fn blender(tree: &Tree, read: &ReadOptions) -> Result<Plan, IngestError> {
    let mut plan = Plan::new(Layout::Blender);
    let train = Table::read(tree, TRAIN, &plan)?;
    train.add_frames(&mut plan, Split::Train, read)?;
    let test = HeldOut::read(tree, TEST, &plan)?;
    if let HeldOut::Frames(test) = test {
        test.add_frames(&mut plan, Split::Test, read)?;
        if tree.has(VALIDATION) {
            plan.notes.push(format!("{VALIDATION} is not used: {TEST} is what is held out"));
            plan.noted.insert(VALIDATION.to_owned());
        }
    } else {
        match HeldOut::read(tree, VALIDATION, &plan)? {
            HeldOut::Frames(validation) => {
                validation.add_frames(&mut plan, Split::Test, read)?;
                plan.notes.push(format!("{}: {VALIDATION} is held out instead", test.lack(TEST)));
            }
            validation => {
                plan.hold_out();
                if matches!(validation, HeldOut::NoPhotographs(_)) {
                    plan.notes.push(validation.lack(VALIDATION));
                }
                plan.notes.push(format!("{}: every 8th image by name is held out", test.lack(TEST)));
            }
        }
    }
    let train = train.document;
    add_points(&mut plan, tree, TRAIN, &train)?;
    plan.ordered(TRAIN)
}

/// Plans a nerfstudio or instant-ngp set.
///
/// # Errors
/// Everything that is wrong with the file, the images it lists or its point cloud.
pub(super) fn nerfstudio(tree: &Tree, read: &ReadOptions) -> Result<Plan, IngestError> {
    let mut plan = Plan::new(Layout::Nerfstudio);
    let table = Table::read(tree, TRANSFORMS, &plan)?;
    table.add_frames(&mut plan, Split::Train, read)?;
    let document = table.document;
    split(&mut plan, &document)?;
    add_points(&mut plan, tree, TRANSFORMS, &document)?;
    plan.ordered(TRANSFORMS)
}

/// Adds the points of the cloud that `file` names, else of the one that lies at the top.
fn add_points(plan: &mut Plan, tree: &Tree, file: &str, document: &Document) -> Result<(), IngestError> {
    let named = match &document.ply_file_path {
        Some(path) => {
            let portable = portable(path);
            let name = safe_name(&portable)
                .map_err(|error| field("/ply_file_path".to_owned(), format!("'{path}': {error}")).at(file))?;
            Some(tree.find(name).unwrap_or(name).to_owned())
        }
        None => tree.find_in_any_case(POINTS).map(str::to_owned),
    };
    match named {
        Some(name) => plan.take_points(ply::read(tree, &name)?, &name),
        // Blender sets usually have none.
        None if plan.layout == Layout::Blender => {}
        None => plan.notes.push(format!(
            "{file} names no point cloud (ply_file_path) and there is no {POINTS}: training starts from random points"
        )),
    }
    Ok(())
}

fn read(tree: &Tree, file: &str) -> Result<Document, IngestError> {
    tree.parse(file, tree.limits().json_bytes, |reader, _| bounded_json::read(reader))
}

/// A file with the images that it lists.
struct Table {
    file: &'static str,
    document: Document,
    images: ImageSearch,
}

impl Table {
    fn read(tree: &Tree, file: &'static str, plan: &Plan) -> Result<Self, IngestError> {
        let document = read(tree, file)?;
        let paths: Vec<&str> = document.frames.iter().map(|frame| frame.file_path.as_str()).collect();
        let files = ImageFiles { tree, listing: file, folders: &[""], taken: &plan.listed };
        let images = files.find(&paths, |index| format!("/frames/{index}/file_path"))?;
        Ok(Self { file, document, images })
    }

    fn add_frames(&self, plan: &mut Plan, split: Split, read: &ReadOptions) -> Result<(), IngestError> {
        let Self { file, document, images } = self;
        let stated = |place: &str, mask: &MaskField| {
            let (place, path) = (format!("{place}{}", mask.pointer), mask.path.clone());
            Arc::new(StatedMask { listing: (*file).to_owned(), place, path })
        };
        let shared = document.mask.as_ref().map(|mask| stated("", mask));
        let mut scales = Vec::new();
        for (index, (frame, found)) in document.frames.iter().zip(&images.found).enumerate() {
            let place = format!("/frames/{index}");
            let mask = frame.mask.as_ref().map(|mask| stated(&place, mask)).or_else(|| shared.clone());
            let (pose, scale) = pose(frame.transform_matrix, &place).map_err(|error| error.at(*file))?;
            scales.extend(scale);
            let lens = lens(&frame.camera, &document.camera, &place).map_err(|error| error.at(*file))?;
            let lens = plan.lens(lens);
            if let Some(FoundImage { name, file: image }) = found.clone() {
                plan.add(PlannedFrame { name, file: image, lens, pose, split, mask }, file);
            }
        }
        if let Some(first) = scales.first() {
            let (count, poses) = (scales.len(), if scales.len() == 1 { "pose" } else { "poses" });
            plan.notes.push(format!(
                "the rotations of {count} {poses} of {file} have a scale, which is taken out: {first:.4}"
            ));
        }
        plan.aliases.extend(images.aliases.clone());
        plan.missing.extend(images.missing_paths().map(str::to_owned));
        images.finish(read, &mut plan.notes)
    }
}

/// What a Blender set has for measuring.
enum HeldOut {
    Frames(Box<Table>),
    NoFile,
    /// An exporter may write a file without frames for programs that insist on one.
    NoFrames,
    /// An add-on writes the poses of a camera path, of which nobody has rendered the pictures yet.
    NoPhotographs(usize),
}

impl HeldOut {
    fn read(tree: &Tree, file: &'static str, plan: &Plan) -> Result<Self, IngestError> {
        if !tree.has(file) {
            return Ok(Self::NoFile);
        }
        let table = Table::read(tree, file, plan)?;
        Ok(match table.images.listed() {
            0 => Self::NoFrames,
            count if table.images.is_empty() => Self::NoPhotographs(count),
            _ => Self::Frames(Box::new(table)),
        })
    }

    /// What is wanting, for a note.
    fn lack(&self, file: &str) -> String {
        match self {
            Self::Frames(_) => file.to_owned(),
            Self::NoFile => format!("{file} is missing"),
            Self::NoFrames => format!("{file} has no frames"),
            Self::NoPhotographs(count) => format!("none of the {count} photographs of {file} is there"),
        }
    }
}

/// Splits by the file's own lists, if it has them, else by the hold-out rule.
fn split(plan: &mut Plan, document: &Document) -> Result<(), IngestError> {
    let (train, test) = (&document.train_filenames, &document.test_filenames);
    if train.is_none() && test.is_none() && document.val_filenames.is_none() {
        plan.hold_out();
        return Ok(());
    }
    let listed = |list: &'static str, names: &Option<Names>| {
        let known: BTreeMap<_, &str> =
            plan.frames.iter().map(|frame| (normalized(&frame.name), frame.name.as_str())).collect();
        let mut listed = BTreeSet::new();
        for stated in names.iter().flat_map(|names| &names.0) {
            let path = portable(stated);
            let found = safe_name(&path).ok().and_then(|name| known.get(&normalized(name)).copied());
            match found.or_else(|| plan.aliases.get(&*normalized(&path)).map(String::as_str)) {
                Some(name) => listed.insert(name.to_owned()),
                None if plan.missing.contains(&*normalized(safe_name(&path).unwrap_or(&path))) => false,
                None => {
                    return Err(IngestErrorKind::UnknownFrame { list, name: stated.clone() }.at(TRANSFORMS));
                }
            };
        }
        Ok(listed)
    };
    let trained = listed("train_filenames", train)?;
    let validated = listed("val_filenames", &document.val_filenames)?;
    let mut held_out = listed("test_filenames", test)?;
    if held_out.is_empty() && !validated.is_empty() {
        held_out = validated;
        plan.notes.push("test_filenames names no image: val_filenames is held out instead".to_owned());
    }
    let before = plan.frames.len();
    for frame in &mut plan.frames {
        frame.split = if held_out.contains(&frame.name) { Split::Test } else { Split::Train };
    }
    if train.is_some() {
        plan.frames.retain(|frame| frame.split == Split::Test || trained.contains(&frame.name));
    }
    let unused = before - plan.frames.len();
    if unused > 0 {
        plan.notes.push(format!("{unused} frames are in no split list that is used and are left out"));
    }
    Ok(())
}

/// A pose, and the scale of its rotation where that is not 1: the axes of some exporters have the length of a unit of theirs. The position
/// is in world units either way.
fn pose(rows: Matrix, place: &str) -> Result<(Pose, Option<f64>)> {
    let Matrix(Some(rows)) = rows else {
        let message = "must be a matrix of 4 rows (or 3) of 4 numbers".to_owned();
        return Err(field(format!("{place}/transform_matrix"), message));
    };
    let [x, y, z, w] = rows.map(DVec4::from_array);
    let matrix = DMat4::from_cols(x, y, z, w).transpose();
    let pose = |matrix| Pose::from_camera_to_world(matrix, Convention::Opengl);
    let scaled = || {
        let scale = matrix.x_axis.truncate().length();
        let unscaled = |axis: DVec4| axis / scale;
        let [x, y, z] = [matrix.x_axis, matrix.y_axis, matrix.z_axis].map(unscaled);
        let unscaled = pose(DMat4::from_cols(x, y, z, matrix.w_axis)).ok()?;
        SCALES.contains(&scale).then_some((unscaled, Some(scale)))
    };
    match pose(matrix) {
        Ok(pose) => Ok((pose, None)),
        Err(source) => scaled()
            .ok_or_else(|| IngestErrorKind::Camera { place: format!("{place}/transform_matrix"), source }),
    }
}

fn lens(frame: &CameraFields, shared: &CameraFields, place: &str) -> Result<Lens> {
    let value = |of: fn(&CameraFields) -> Option<f64>| of(frame).or(of(shared));
    let distortion = distortion(frame, shared, place)?;
    // A frame that states any focal length states all of it: half of it from elsewhere would be another camera.
    let owner = if frame.fl_x.or(frame.camera_angle_x).is_some() { frame } else { shared };
    let focal = match (owner.fl_x, owner.camera_angle_x) {
        (Some(x), _) => Focal::Pixels { x, y: owner.fl_y.unwrap_or(x) },
        (None, Some(x)) => Focal::FieldOfView { x, y: owner.camera_angle_y },
        (None, None) => {
            return Err(field(
                place.to_owned(),
                "no focal length: neither fl_x nor camera_angle_x is stated".to_owned(),
            ));
        }
    };
    let size = match (frame.w.or(shared.w), frame.h.or(shared.h)) {
        (Some(w), Some(h)) => Some((side(w, place, "w")?, side(h, place, "h")?)),
        (None, None) => None,
        _ => return Err(field(place.to_owned(), "only one of w and h is stated".to_owned())),
    };
    let lens =
        Lens { focal, principal: [value(|fields| fields.cx), value(|fields| fields.cy)], size, distortion };
    if !lens.distortion.is_finite() {
        return Err(IngestErrorKind::NonFiniteDistortion { place: place.to_owned() });
    }
    lens.check().map_err(|source| IngestErrorKind::Camera { place: place.to_owned(), source })?;
    Ok(lens)
}

/// The distortion that a camera model's fields state.
fn distortion(frame: &CameraFields, shared: &CameraFields, place: &str) -> Result<Distortion> {
    let value = |of: fn(&CameraFields) -> Option<f64>| of(frame).or(of(shared)).unwrap_or(0.0);
    let [k1, k2, k3] = [value(|fields| fields.k1), value(|fields| fields.k2), value(|fields| fields.k3)];
    let [k4, k5, k6] = [value(|fields| fields.k4), value(|fields| fields.k5), value(|fields| fields.k6)];
    let tangential = [value(|fields| fields.p1), value(|fields| fields.p2)];
    let fisheye = Distortion::Projection(Projection::Fisheye { radial: [k1, k2, k3, k4] });
    let is_fisheye = frame.is_fisheye.or(shared.is_fisheye) == Some(true);
    let model = frame.camera_model.as_deref().or(shared.camera_model.as_deref());
    match model {
        Some(model) if PANORAMAS.contains(&model) => {
            Err(IngestErrorKind::Panorama { place: place.to_owned(), model: model.to_owned() })
        }
        Some("OPENCV_FISHEYE") => Ok(fisheye),
        Some("FISHEYE624") => match frame.distortion_params.or(shared.distortion_params) {
            Some(Parameters(Some([k0, k1, k2, k3, k4, k5, p0, p1, prism @ ..]))) => {
                let (radial, tangential) = ([k0, k1, k2, k3, k4, k5], [p0, p1]);
                Ok(Distortion::Projection(Projection::RadTanThinPrismFisheye { radial, tangential, prism }))
            }
            _ => {
                let message = "FISHEYE624 needs the 12 numbers of distortion_params".to_owned();
                Err(field(place.to_owned(), message))
            }
        },
        None | Some(_) if is_fisheye => Ok(fisheye),
        Some("FULL_OPENCV") if [k4, k5, k6] != [0.0; 3] => {
            Ok(Distortion::Projection(Projection::Rational { radial: [k1, k2, k3, k4, k5, k6], tangential }))
        }
        None | Some("FULL_OPENCV") => {
            Ok(Distortion::Polynomial(Polynomial { radial: [k1, k2, k3, k4], tangential }))
        }
        Some(model) if POLYNOMIAL_MODELS.contains(&model) => {
            Ok(Distortion::Polynomial(Polynomial { radial: [k1, k2, k3, k4], tangential }))
        }
        Some(model) => Err(IngestErrorKind::CameraModel { place: place.to_owned(), model: model.to_owned() }),
    }
}

/// A side in pixels. Some converters write it as `1920.0`, or as the product of a side and a scale, such as `503.99999999999994`.
fn side(value: f64, place: &str, name: &str) -> Result<u32> {
    let whole = value.round();
    if (value - whole).abs() <= WHOLE && (1.0..=f64::from(u32::MAX)).contains(&whole) {
        Ok(whole as u32)
    } else {
        Err(field(
            place.to_owned(),
            format!("{name} is {value}; it must be a positive whole number of pixels"),
        ))
    }
}

fn field(pointer: String, message: String) -> IngestErrorKind {
    IngestErrorKind::Field { pointer, message }
}
