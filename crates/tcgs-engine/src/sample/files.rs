//! Writes the scene in nerfstudio's layout (`transforms.json`, `images/*.png`, `sparse_pc.ply`), or as bare photographs (`*.jpg`), as a
//! folder or as the zip that the service takes.

use std::path::Path;

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use serde_json::json;

use super::{SampleCounts, SampleError, Settings, output::Output, points, scene::Scene, views};
use crate::domain::{Camera, Convention, Image, PointCloud};

/// Folder of the images, and file of the points, inside the scene's folder.
const IMAGES: &str = "images";
const POINTS: &str = "sparse_pc.ply";

/// Quality of bare photographs, as cameras write them.
const JPEG_QUALITY: u8 = 92;

/// Renders the scene and writes it to `path`: one zip if the name ends in `.zip`, else a folder, which must be
/// empty or not exist yet.
///
/// # Errors
/// [`SampleError`]: something is there already, the size is impossible, or the file system refuses.
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
    settings.check()?;
    let mut output = Output::create(path)?;
    let written = write_to(&mut output, settings, watch)?;
    output.finish()?;
    Ok(written)
}

/// One image at a time, since all of them may not fit into memory.
fn write_to(
    output: &mut Output,
    settings: &Settings,
    watch: &mut dyn FnMut(usize, usize),
) -> Result<SampleCounts, SampleError> {
    let scene = Scene::still_life();
    let cameras = views::cameras(settings);
    for (index, camera) in cameras.iter().enumerate() {
        let image = scene.render(camera);
        let bytes = if settings.is_bare { jpeg(&image)? } else { png(&image)? };
        output.write(&image_name(settings, index), &bytes)?;
        watch(index + 1, cameras.len());
    }
    if settings.is_bare {
        return Ok(SampleCounts { train: cameras.len(), test: 0, points: 0 });
    }
    let cloud = points::cloud(&scene, &cameras, settings.points, settings.seed);
    output.write(POINTS, &ply_bytes(&cloud))?;
    // Last, so that a folder with this file is a whole scene.
    output.write("transforms.json", transforms_json(settings, &cameras).as_bytes())?;
    let test = (0..cameras.len()).filter(|index| views::is_held_out(*index)).count();
    Ok(SampleCounts { train: cameras.len() - test, test, points: cloud.positions.len() })
}

fn image_name(settings: &Settings, index: usize) -> String {
    let digits = (settings.views - 1).to_string().len().max(2);
    if settings.is_bare {
        format!("view_{index:0digits$}.jpg")
    } else {
        format!("{IMAGES}/view_{index:0digits$}.png")
    }
}

fn png(image: &Image) -> Result<Vec<u8>, SampleError> {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new(&mut bytes);
    encoder.write_image(image.samples(), image.width(), image.height(), ExtendedColorType::Rgb8)?;
    Ok(bytes)
}

fn jpeg(image: &Image) -> Result<Vec<u8>, SampleError> {
    let mut bytes = Vec::new();
    let encoder = jpeg_encoder::Encoder::new(&mut bytes, JPEG_QUALITY);
    let (width, height) = (image.width() as u16, image.height() as u16);
    encoder.encode(image.samples(), width, height, jpeg_encoder::ColorType::Rgb)?;
    Ok(bytes)
}

fn transforms_json(settings: &Settings, cameras: &[Camera]) -> String {
    let k = &cameras[0].intrinsics;
    let frames: Vec<_> = cameras
        .iter()
        .enumerate()
        .map(|(index, camera)| {
            let rows = camera.pose.camera_to_world(Convention::Opengl).transpose().to_cols_array_2d();
            json!({ "file_path": image_name(settings, index), "transform_matrix": rows })
        })
        .collect();
    let names = |held_out: bool| -> Vec<String> {
        let chosen = (0..cameras.len()).filter(|index| views::is_held_out(*index) == held_out);
        chosen.map(|index| image_name(settings, index)).collect()
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
    use std::{
        fs,
        io::{Cursor, Read},
    };

    use super::*;
    use crate::domain::Pose;

    const SMALL: Settings = Settings { points: 100, ..Settings::square(16) };

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
        let impossible = Settings { height: 0, ..SMALL };
        assert!(matches!(write(folder.path(), &impossible), Err(SampleError::Size(16, 0))));
        assert!(matches!(write(folder.path(), &Settings { views: 2, ..SMALL }), Err(SampleError::Views(2))));
    }

    #[test]
    fn transforms_give_back_the_cameras_that_rendered() {
        let settings = Settings { width: 24, ..SMALL };
        let cameras = views::cameras(&settings);
        let document: serde_json::Value =
            serde_json::from_str(&transforms_json(&settings, &cameras)).expect("JSON");
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
    #[test]
    fn bare_photographs_are_as_many_and_as_large_as_asked_for() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let settings = Settings { width: 32, height: 16, views: 101, is_bare: true, ..SMALL };
        let written = write(folder.path(), &settings).expect("writes");
        assert_eq!(written, SampleCounts { train: 101, test: 0, points: 0 });
        let mut names: Vec<_> =
            fs::read_dir(folder.path()).expect("a folder").flatten().map(|entry| entry.path()).collect();
        names.sort();
        assert_eq!(names.len(), 101);
        assert!(names[7].ends_with("view_007.jpg"), "{names:?}");
        let size = image::image_dimensions(&names[100]).expect("a picture");
        assert_eq!(size, (32, 16));
    }
}
