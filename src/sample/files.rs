//! Writes the scene in nerfstudio's layout: `transforms.json`, `images/*.png`, `sparse_pc.ply`.

use std::{
    fs,
    path::{Path, PathBuf},
};

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use serde_json::json;

use super::{SampleError, Settings, Written, points, scene::Scene, views};
use crate::domain::{Camera, Convention, Image, PointCloud};

/// Folder of the images, and file of the points, inside the scene's folder.
const IMAGES: &str = "images";
const POINTS: &str = "sparse_pc.ply";

/// Renders the scene and writes it into `directory`, which must be empty or not exist yet.
///
/// # Errors
/// [`SampleError`]: the folder is not empty, the side is impossible, or the file system refuses.
pub fn write(directory: &Path, settings: &Settings) -> Result<Written, SampleError> {
    if !(8..=4096).contains(&settings.side) {
        return Err(SampleError::Side(settings.side));
    }
    let io = |path: &Path| {
        let path = path.to_owned();
        move |source| SampleError::Io { path, source }
    };
    let images = directory.join(IMAGES);
    if directory.exists() && fs::read_dir(directory).map_err(io(directory))?.next().is_some() {
        return Err(SampleError::NotEmpty(directory.to_owned()));
    }
    fs::create_dir_all(&images).map_err(io(&images))?;

    let scene = Scene::still_life();
    let cameras = views::cameras(settings.side);
    for (index, camera) in cameras.iter().enumerate() {
        let path = directory.join(image_name(index));
        let bytes = png(&scene.render(camera), &path)?;
        fs::write(&path, bytes).map_err(io(&path))?;
    }
    let cloud = points::cloud(&scene, &cameras, settings.points, settings.seed);
    let ply = directory.join(POINTS);
    fs::write(&ply, ply_bytes(&cloud)).map_err(io(&ply))?;
    // Last, so that a folder with this file is a whole scene.
    let transforms = directory.join("transforms.json");
    fs::write(&transforms, transforms_json(&cameras)).map_err(io(&transforms))?;

    let test = (0..cameras.len()).filter(|index| views::is_held_out(*index)).count();
    Ok(Written { train: cameras.len() - test, test, points: cloud.positions.len() })
}

fn image_name(index: usize) -> String {
    format!("{IMAGES}/view_{index:02}.png")
}

fn png(image: &Image, path: &Path) -> Result<Vec<u8>, SampleError> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(image.samples(), image.width(), image.height(), ExtendedColorType::Rgb8)
        .map_err(|source| SampleError::Png { path: PathBuf::from(path), source })?;
    Ok(bytes)
}

fn transforms_json(cameras: &[Camera]) -> String {
    let k = &cameras[0].intrinsics;
    let frames: Vec<_> = cameras
        .iter()
        .enumerate()
        .map(|(index, camera)| {
            let rows = camera.pose.camera_to_world(Convention::Opengl).transpose().to_cols_array_2d();
            json!({ "file_path": image_name(index), "transform_matrix": rows })
        })
        .collect();
    let names = |held_out: bool| -> Vec<String> {
        (0..cameras.len()).filter(|index| views::is_held_out(*index) == held_out).map(image_name).collect()
    };
    let document = json!({
        "camera_model": "OPENCV",
        "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width, "h": k.height,
        "ply_file_path": POINTS,
        "train_filenames": names(false),
        "val_filenames": names(true),
        "test_filenames": names(true),
        "frames": frames,
    });
    format!("{document:#}\n")
}

fn ply_bytes(cloud: &PointCloud) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\n\
         property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        cloud.positions.len()
    )
    .into_bytes();
    for (position, color) in cloud.positions.iter().zip(&cloud.colors) {
        position.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        bytes.extend(color);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Digest, Pose};

    const SMALL: Settings = Settings { side: 16, points: 100, seed: 1 };

    fn digest_of(directory: &Path) -> Digest {
        let mut paths: Vec<PathBuf> = [directory.to_owned(), directory.join(IMAGES)]
            .iter()
            .flat_map(|folder| fs::read_dir(folder).expect("a folder"))
            .map(|entry| entry.expect("an entry").path())
            .filter(|path| path.is_file())
            .collect();
        paths.sort();
        assert_eq!(paths.len(), 50);
        let bytes: Vec<u8> = paths.iter().flat_map(|path| fs::read(path).expect("a file")).collect();
        Digest::of(&bytes)
    }

    #[test]
    fn two_runs_write_the_same_bytes() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (a, b) = (folder.path().join("a"), folder.path().join("b"));
        let written = write(&a, &SMALL).expect("writes");
        assert_eq!(written, Written { train: 40, test: 8, points: 100 });
        write(&b, &SMALL).expect("writes");
        assert_eq!(digest_of(&a), digest_of(&b));
    }

    #[test]
    fn a_folder_with_something_in_it_is_left_alone() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        fs::write(folder.path().join("notes.txt"), "mine").expect("writes");
        let fault = write(folder.path(), &SMALL).expect_err("refused");
        assert!(matches!(fault, SampleError::NotEmpty(_)));
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 1);
        assert!(matches!(write(folder.path(), &Settings { side: 0, ..SMALL }), Err(SampleError::Side(0))));
    }

    #[test]
    fn transforms_give_back_the_cameras_that_rendered() {
        let cameras = views::cameras(16);
        let document: serde_json::Value = serde_json::from_str(&transforms_json(&cameras)).expect("JSON");
        for (camera, frame) in cameras.iter().zip(document["frames"].as_array().expect("frames")) {
            let rows: [[f64; 4]; 4] =
                serde_json::from_value(frame["transform_matrix"].clone()).expect("a matrix");
            let matrix = glam::DMat4::from_cols_array_2d(&rows).transpose();
            let pose = Pose::from_camera_to_world(matrix, Convention::Opengl).expect("a rigid pose");
            assert!(pose.center().distance(camera.pose.center()) < 1e-9);
            let point = glam::DVec3::new(0.3, 0.2, 0.4);
            let same = Camera { pose, ..*camera };
            let (a, b) = (camera.project(point).expect("in front"), same.project(point).expect("in front"));
            assert!(a.0.distance(b.0) < 1e-6);
        }
    }
}
