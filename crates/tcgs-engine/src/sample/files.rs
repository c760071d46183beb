//! Writes the scene in nerfstudio's layout (`transforms.json`, `images/*.png`, `sparse_pc.ply`), as a folder or as
//! the zip that the service takes.

use std::{
    fs,
    io::{Cursor, Write},
    path::Path,
};

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use serde_json::json;
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use super::{SampleCounts, SampleError, Settings, points, scene::Scene, views};
use crate::domain::{Camera, Convention, Image, PointCloud};

/// Folder of the images, and file of the points, inside the scene's folder.
const IMAGES: &str = "images";
const POINTS: &str = "sparse_pc.ply";

/// The files of the scene by name, in the order in which they are to be written.
struct Files {
    entries: Vec<(String, Vec<u8>)>,
    written: SampleCounts,
}

/// Renders the scene and writes it to `path`: one zip if the name ends in `.zip`, else a folder, which must be
/// empty or not exist yet.
///
/// # Errors
/// [`SampleError`]: something is there already, the side is impossible, or the file system refuses.
pub fn write(path: &Path, settings: &Settings) -> Result<SampleCounts, SampleError> {
    write_watched(path, settings, &mut |_, _| ())
}

/// As [`write`]; tells `watch` after each image how many are drawn, of how many.
///
/// # Errors
/// As [`write`].
pub fn write_watched(
    path: &Path,
    settings: &Settings,
    watch: &mut dyn FnMut(usize, usize),
) -> Result<SampleCounts, SampleError> {
    if !(8..=4096).contains(&settings.side) {
        return Err(SampleError::Side(settings.side));
    }
    let is_zip = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("zip"));
    if is_zip && path.exists() {
        return Err(SampleError::Exists(path.to_owned()));
    }
    if !is_zip && path.exists() && read_dir(path)?.next().is_some() {
        return Err(SampleError::NotEmpty(path.to_owned()));
    }
    let files = files(settings, watch)?;
    if is_zip {
        write_file(path, &zip_bytes(&files.entries)?)?;
        return Ok(files.written);
    }
    let mut written = Vec::new();
    for (name, bytes) in &files.entries {
        let file = path.join(name);
        if let Err(error) = write_file(&file, bytes) {
            // So that a second try, once there is room, finds the folder as empty as the first did. The first error counts.
            written.iter().for_each(|file| drop(fs::remove_file(file)));
            drop(fs::remove_dir(path.join(IMAGES)));
            return Err(error);
        }
        written.push(file);
    }
    Ok(files.written)
}

fn files(settings: &Settings, watch: &mut dyn FnMut(usize, usize)) -> Result<Files, SampleError> {
    let scene = Scene::still_life();
    let cameras = views::cameras(settings.side);
    let cloud = points::cloud(&scene, &cameras, settings.points, settings.seed);
    let test = (0..cameras.len()).filter(|index| views::is_held_out(*index)).count();
    let written = SampleCounts { train: cameras.len() - test, test, points: cloud.positions.len() };

    let mut entries = Vec::with_capacity(cameras.len() + 2);
    for (index, camera) in cameras.iter().enumerate() {
        entries.push((image_name(index), png(&scene.render(camera))?));
        watch(index + 1, cameras.len());
    }
    entries.push((POINTS.to_owned(), ply_bytes(&cloud)));
    // Last, so that a folder with this file is a whole scene.
    entries.push(("transforms.json".to_owned(), transforms_json(&cameras).into_bytes()));
    Ok(Files { entries, written })
}

fn io_error(path: &Path) -> impl FnOnce(std::io::Error) -> SampleError {
    let path = path.to_owned();
    move |source| SampleError::Io { path, source }
}

fn read_dir(path: &Path) -> Result<fs::ReadDir, SampleError> {
    fs::read_dir(path).map_err(io_error(path))
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<(), SampleError> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(io_error(folder))?;
    }
    fs::write(path, bytes).map_err(|error| {
        // A full disk leaves the beginning of the file, which is no use to anybody. The first error counts.
        drop(fs::remove_file(path));
        io_error(path)(error)
    })
}

/// The entries as a zip without times, so that its bytes depend on theirs alone. Stored, since PNG is compressed.
fn zip_bytes(entries: &[(String, Vec<u8>)]) -> Result<Vec<u8>, SampleError> {
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Stored)
        .last_modified_time(zip::DateTime::default());
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        zip.start_file(name.as_str(), options)?;
        zip.write_all(bytes).map_err(zip::result::ZipError::from)?;
    }
    Ok(zip.finish()?.into_inner())
}

fn image_name(index: usize) -> String {
    format!("{IMAGES}/view_{index:02}.png")
}

fn png(image: &Image) -> Result<Vec<u8>, SampleError> {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new(&mut bytes);
    encoder.write_image(image.samples(), image.width(), image.height(), ExtendedColorType::Rgb8)?;
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
        position.iter().for_each(|value| bytes.extend((*value as f32).to_le_bytes()));
        bytes.extend(color);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;
    use crate::domain::Pose;

    const SMALL: Settings = Settings { side: 16, points: 100, seed: 1 };

    #[test]
    fn two_runs_write_the_same_bytes_and_the_zip_holds_the_folder() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (directory, a, b) =
            (folder.path().join("scene"), folder.path().join("a.zip"), folder.path().join("b.ZIP"));
        let written = write(&directory, &SMALL).expect("writes");
        assert_eq!(written, SampleCounts { train: 40, test: 8, points: 100 });
        write(&a, &SMALL).expect("writes");
        write(&b, &SMALL).expect("writes");
        let bytes = fs::read(&a).expect("a file");
        assert!(bytes == fs::read(&b).expect("a file"), "two runs differ");

        let mut zip = zip::ZipArchive::new(Cursor::new(bytes)).expect("a zip");
        assert_eq!(zip.len(), 50);
        for index in 0..zip.len() {
            let mut entry = zip.by_index(index).expect("an entry");
            let name = entry.name().expect("a readable name").into_owned();
            let mut content = Vec::new();
            entry.read_to_end(&mut content).expect("readable");
            assert!(content == fs::read(directory.join(&name)).expect("the same file"), "{name}");
        }
    }

    #[test]
    fn what_is_there_already_is_left_alone() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        fs::write(folder.path().join("notes.txt"), "mine").expect("writes");
        let error = write(folder.path(), &SMALL).expect_err("refused");
        assert!(matches!(error, SampleError::NotEmpty(_)));
        let zip = folder.path().join("mine.zip");
        fs::write(&zip, "mine").expect("writes");
        assert!(matches!(write(&zip, &SMALL), Err(SampleError::Exists(_))));
        assert_eq!(fs::read(&zip).expect("a file"), b"mine");
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 2);
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
