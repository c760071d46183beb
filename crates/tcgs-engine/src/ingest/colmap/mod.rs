//! COLMAP models: `cameras`, `images` and `points3D`, binary or text, with the photographs under `images/`.
//!
//! Poses are world-to-camera quaternions in OpenCV axes and pixel centers are at +0.5, which is what the domain
//! uses, so nothing is converted. Rig and frame tables of newer versions are not needed and not read.

mod binary;
mod cameras;
mod model;
mod text;

use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat3, DQuat, DVec3};

pub(super) use self::model::{Choice, detect};
use self::text::Lines;
use super::{
    error::{IngestError, IngestErrorKind, Result},
    image_files::{FoundImage, ImageFiles},
    plan::{Plan, PlannedFrame, RecordCounter},
    ply,
    points::Points,
    table_reader::TableReader,
    tree::Tree,
};
use crate::domain::{CameraError, Layout, Pose, ReadOptions, Split};

/// Where the photographs lie.
const IMAGES: &str = "images/";

/// A row of the images table, except for its points.
#[derive(Debug, Clone, PartialEq)]
struct ImageRecord {
    id: u32,
    /// (w, x, y, z), world to camera, any length but zero.
    quaternion: [f64; 4],
    translation: [f64; 3],
    camera: u32,
    name: String,
}

/// Plans a COLMAP set.
///
/// # Errors
/// Everything that is wrong with the tables or the images they list.
pub(super) fn plan(tree: &Tree, choice: Choice, read: &ReadOptions) -> Result<Plan, IngestError> {
    let Choice { model, unused, note } = choice;
    let [cameras_file, images_file] = ["cameras", "images"].map(|name| model.table(name));
    let missing = |file: &str| {
        tree.special_on_path(file).unwrap_or_else(|| {
            let needed = "a COLMAP model has cameras and images, and points3D if there are points (.bin or .txt; the points also .ply)";
            IngestErrorKind::MissingFile(needed).at(file)
        })
    };
    if !tree.has(&images_file) {
        return Err(missing(&images_file));
    }
    let points_files = model.points(tree);
    if points_files.is_empty()
        && let Some(link) = tree.special_on_path(&model.table("points3D"))
    {
        return Err(link);
    }
    let cameras = parse(tree, &cameras_file, binary::cameras, text::cameras)?;
    let images = parse(tree, &images_file, binary::images, text::images)?;
    let points = first_points(tree, &points_files)?;

    let mut plan = Plan::new(Layout::Colmap);
    let mut lenses = BTreeMap::new();
    for record in &cameras {
        let lens = record.lens().map_err(|error| error.at(&cameras_file))?;
        plan.lenses.push(lens);
        if lenses.insert(record.id, plan.lenses.len() - 1).is_some() {
            return Err(IngestErrorKind::DuplicateName(format!("camera {}", record.id)).at(&cameras_file));
        }
    }

    let folders = [IMAGES, model.folder()];
    let flat = if model.folder().is_empty() { &folders[..] } else { &folders[..1] };
    let files = ImageFiles { tree, listing: &images_file, folders: flat, taken: &BTreeSet::new() };
    let names: Vec<&str> = images.iter().map(|image| image.name.as_str()).collect();
    let mut search = files.find(&names, |index| format!("image {}", images[index].id))?;
    for (image, found) in images.iter().zip(std::mem::take(&mut search.found)) {
        let place = format!("image {}", image.id);
        let lens = *lenses.get(&image.camera).ok_or_else(|| {
            let message = format!("there is no camera {} in {cameras_file}", image.camera);
            IngestErrorKind::Record { place: place.clone(), message }.at(&images_file)
        })?;
        let pose = pose(image, &place).map_err(|error| error.at(&images_file))?;
        if let Some(FoundImage { name, file }) = found {
            plan.add(PlannedFrame { name, file, lens, pose, split: Split::Train, mask: None }, &images_file);
        }
    }
    search.finish(read, &mut plan.notes)?;
    plan.hold_out();
    plan.notes.extend(note);
    plan.noted = unused;
    match points {
        Some((file, points)) => plan.take_points(points, file),
        None => plan
            .notes
            .push(format!("there is no {}: training starts from random points", model.table("points3D"))),
    }
    plan.ordered(&images_file)
}

/// The points of the first file that has any, else those of the first: some programs write an empty table, and the points beside it.
fn first_points<'a>(tree: &Tree, files: &[&'a str]) -> Result<Option<(&'a str, Points)>, IngestError> {
    let mut first = None;
    for file in files {
        let points = points(tree, file)?;
        if points.count() > 0 {
            return Ok(Some((file, points)));
        }
        first.get_or_insert((*file, points));
    }
    Ok(first)
}

fn points(tree: &Tree, file: &str) -> Result<Points, IngestError> {
    if file.ends_with(".ply") {
        return ply::read(tree, file);
    }
    parse(
        tree,
        file,
        |bytes| kept(tree, |points| binary::points(bytes, points)),
        |lines| kept(tree, |points| text::points(lines, points)),
    )
}

fn parse<T>(
    tree: &Tree,
    file: &str,
    binary: impl FnOnce(TableReader) -> Result<T>,
    text: impl FnOnce(&mut Lines) -> Result<T>,
) -> Result<T, IngestError> {
    let is_binary = file.ends_with(".bin");
    tree.parse(file, u64::MAX, |reader, length| {
        if is_binary { binary(TableReader::new(reader, length)) } else { text(&mut Lines::new(reader)) }
    })
}

fn kept(tree: &Tree, fill: impl FnOnce(&mut Points) -> Result<()>) -> Result<Points> {
    let mut points = tree.points();
    fill(&mut points)?;
    Ok(points)
}

fn pose(image: &ImageRecord, place: &str) -> Result<Pose> {
    let [w, x, y, z] = image.quaternion;
    let quaternion = DQuat::from_xyzw(x, y, z, w);
    if !quaternion.is_finite() {
        return Err(IngestErrorKind::Camera { place: place.to_owned(), source: CameraError::NonFinitePose });
    }
    let length = quaternion.length();
    if !(length > 0.0 && length.is_finite()) {
        return Err(IngestErrorKind::Camera {
            place: place.to_owned(),
            source: CameraError::NoRotation(length),
        });
    }
    Pose::from_world_to_camera(DMat3::from_quat(quaternion / length), DVec3::from_array(image.translation))
        .map_err(|source| IngestErrorKind::Camera { place: place.to_owned(), source })
}

/// Adds a point with the checks that both encodings share.
fn push_point(cloud: &mut Points, id: u64, position: [f64; 3], color: [u8; 3]) -> Result<()> {
    if position.iter().any(|value| !(*value as f32).is_finite()) {
        let message = "the position is not finite".to_owned();
        return Err(IngestErrorKind::Record { place: format!("point {id}"), message });
    }
    cloud.push(position, color)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(quaternion: [f64; 4], translation: [f64; 3]) -> ImageRecord {
        ImageRecord { id: 7, quaternion, translation, camera: 1, name: "a.png".to_owned() }
    }

    #[test]
    fn quaternions_of_any_length_turn_the_same_way() {
        let one = pose(&record([0.5, 0.5, 0.5, 0.5], [1.0, 2.0, 3.0]), "image 7").expect("a pose");
        let three = pose(&record([1.5, 1.5, 1.5, 1.5], [1.0, 2.0, 3.0]), "image 7").expect("a pose");
        assert!((one.rotation() - three.rotation()).to_cols_array().iter().all(|v| v.abs() < 1e-12));
        // A third of a turn around (1, 1, 1): x goes to y, y to z, z to x.
        assert!((one.rotation() * DVec3::X - DVec3::Y).length() < 1e-12);
        assert_eq!(one.translation(), DVec3::new(1.0, 2.0, 3.0));
    }

    #[test]
    fn poison_poses_are_refused() {
        for poison in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX] {
            assert!(pose(&record([poison, 0.0, 0.0, 0.0], [0.0; 3]), "image 7").is_err(), "{poison}");
            if !poison.is_finite() {
                assert!(pose(&record([1.0, 0.0, 0.0, 0.0], [0.0, poison, 0.0]), "image 7").is_err());
            }
        }
        let error = pose(&record([0.0; 4], [0.0; 3]), "image 7").expect_err("no direction");
        assert_eq!(error.to_string(), "image 7: the rotation quaternion has length 0 and so no direction");
    }
}
