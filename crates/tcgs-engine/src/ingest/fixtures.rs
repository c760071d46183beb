//! Tiny datasets made in code, as directories and as zip archives.

use std::{
    collections::BTreeMap,
    fs,
    io::{Cursor, Write as _},
    path::PathBuf,
};

use image::{DynamicImage, ImageBuffer, ImageFormat, Rgba};
use tempfile::TempDir;
use zip::{ZipWriter, write::SimpleFileOptions};

/// Size of the images.
pub(super) const SIZE: (u32, u32) = (8, 6);

/// Files by name; equal to itself whatever it is written as.
#[derive(Clone, Default)]
pub(super) struct Set(pub(super) BTreeMap<String, Vec<u8>>);

/// A set written somewhere for as long as this lives.
pub(super) struct TempFile {
    pub(super) path: PathBuf,
    _folder: TempDir,
}

impl Set {
    pub(super) fn with(mut self, name: &str, content: impl Into<Vec<u8>>) -> Self {
        self.0.insert(name.to_owned(), content.into());
        self
    }

    pub(super) fn without(mut self, name: &str) -> Self {
        assert!(self.0.remove(name).is_some(), "the fixture has no {name}");
        self
    }

    /// With one passage of a text file replaced.
    pub(super) fn edited(mut self, name: &str, from: &str, to: &str) -> Self {
        let text = String::from_utf8(self.0[name].clone()).expect("a text file");
        assert!(text.contains(from), "{name} has no '{from}'");
        self.0.insert(name.to_owned(), text.replacen(from, to, 1).into_bytes());
        self
    }

    /// The same set inside a folder.
    pub(super) fn inside(self, folder: &str) -> Self {
        Self(self.0.into_iter().map(|(name, content)| (format!("{folder}/{name}"), content)).collect())
    }

    pub(super) fn directory(&self) -> TempFile {
        let folder = tempfile::tempdir().expect("a temporary folder");
        for (name, content) in &self.0 {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().expect("a parent")).expect("created");
            fs::write(path, content).expect("written");
        }
        TempFile { path: folder.path().to_owned(), _folder: folder }
    }

    pub(super) fn archive(&self) -> Vec<u8> {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        for (name, content) in &self.0 {
            zip.start_file(name.as_str(), SimpleFileOptions::default()).expect("an entry");
            zip.write_all(content).expect("written");
        }
        zip.finish().expect("an archive").into_inner()
    }
}

/// Bytes written to a file.
pub(super) fn file(bytes: &[u8]) -> TempFile {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("dataset.zip");
    fs::write(&path, bytes).expect("written");
    TempFile { path, _folder: folder }
}

/// A PNG of one color, with alpha unless it is opaque.
pub(super) fn png((width, height): (u32, u32), color: [u8; 4]) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let image = DynamicImage::from(ImageBuffer::from_pixel(width, height, Rgba(color)));
    let image = if color[3] == 255 { image.into_rgb8().into() } else { image };
    image.write_to(&mut bytes, ImageFormat::Png).expect("encodes");
    bytes.into_inner()
}

const POSE: &str = "[[1,0,0,0.5],[0,1,0,0.25],[0,0,1,4],[0,0,0,1]]";

fn frames(names: &[&str]) -> String {
    let frames: Vec<String> = names
        .iter()
        .map(|name| format!("{{\"file_path\": \"{name}\", \"transform_matrix\": {POSE}}}"))
        .collect();
    format!("[{}]", frames.join(",\n"))
}

/// Two training and one test image.
pub(super) fn blender() -> Set {
    let table = |names| format!("{{\"camera_angle_x\": 0.8,\n\"frames\": {}}}", frames(names));
    Set::default()
        .with("transforms_train.json", table(&["./train/r_0", "./train/r_1"]))
        .with("transforms_val.json", table(&["./val/r_0"]))
        .with("transforms_test.json", table(&["./test/r_0"]))
        .with("train/r_0.png", png(SIZE, [10, 20, 30, 128]))
        .with("train/r_1.png", png(SIZE, [11, 21, 31, 0]))
        .with("val/r_0.png", png(SIZE, [12, 22, 32, 255]))
        .with("test/r_0.png", png(SIZE, [13, 23, 33, 255]))
}

/// Nine images and one point.
pub(super) fn nerfstudio() -> Set {
    let names: Vec<String> = (0..9).map(|index| format!("images/{index}.png")).collect();
    let listed: Vec<&str> = names.iter().map(String::as_str).collect();
    let table = format!(
        "{{\"camera_model\": \"OPENCV\", \"fl_x\": 9.0, \"fl_y\": 9.5, \"cx\": 4.25, \"cy\": 3.0, \"w\": 8, \
         \"h\": 6.0, \"k1\": 0.0,\n\"applied_transform\": [[0,1,0,0],[1,0,0,0],[0,0,-1,5]],\n\
         \"ply_file_path\": \"points.ply\",\n\"frames\": {}}}",
        frames(&listed)
    );
    let ply = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
               end_header\n1 2 3\n";
    let set = Set::default().with("transforms.json", table).with("points.ply", ply);
    names.iter().fold(set, |set, name| set.with(name, png(SIZE, [9, 8, 7, 255])))
}

/// Nine images, a camera and two points in text form.
pub(super) fn colmap() -> Set {
    let images: String = (0..9)
        .map(|index| format!("{} 1 0 0 0 0.5 0.25 4 1 {index}.png\n1 2 -1 3 4 7\n", index + 1))
        .collect();
    let set = Set::default()
        .with("sparse/0/cameras.txt", "# cameras\n1 PINHOLE 8 6 9 9.5 4.25 3\n")
        .with("sparse/0/images.txt", images)
        .with("sparse/0/points3D.txt", "1 1 2 3 10 20 30 0.1 1 0\n2 -1 2 3 10 20 30 0.1 1 0\n");
    (0..9).fold(set, |set, index| set.with(&format!("images/{index}.png"), png(SIZE, [9, 8, index, 255])))
}
