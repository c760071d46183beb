//! A posed image set: frames with their cameras and pixels, an optional point cloud, and the hold-out rule.
//!
//! In a [`Dataset`] every frame's image, and its mask if it has one, has exactly its camera's size, names are unique, frames are sorted by
//! name within their split, and at least one frame is for training.

use serde::{Deserialize, Serialize};

use tcgs_codec::named_choice;

use super::{Camera, Digest, Photograph, PixelMask};

/// Every eighth image by name is held out if the layout has no test split (METHOD.md §1.1).
pub const HOLD_OUT_EVERY: usize = 8;

/// Extensions of the image formats that are read, lower case.
pub const IMAGE_EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

named_choice! {
    /// How the files of a dataset are laid out.
    pub enum Layout {
        /// `transforms_{train,val,test}.json`, OpenGL camera-to-world, `camera_angle_x`.
        Blender = "blender",
        /// One `transforms.json` (nerfstudio, instant-ngp).
        Nerfstudio = "nerfstudio",
        /// `sparse/0` with cameras, images and points3D, binary or text.
        Colmap = "colmap",
        /// Photographs without cameras, which are found before training.
        Photographs = "photographs",
        /// A video, of which photographs are taken and cameras found before training.
        Video = "video",
    }
}

impl Layout {
    /// Whether cameras are to be found before there is anything to train on.
    #[must_use]
    pub fn lacks_cameras(self) -> bool {
        matches!(self, Self::Photographs | Self::Video)
    }
}

/// The split that a frame belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// For training.
    Train,
    /// Held out for the reported metrics.
    Test,
}

/// What is known of a dataset without decoding its images.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DatasetSummary {
    /// How its files are laid out.
    pub layout: Layout,
    /// Frames to train on.
    pub train: usize,
    /// Frames held out.
    pub test: usize,
    /// Pixels of all images after undistortion.
    pub pixels: u64,
    /// Structure-from-motion points, if it has any.
    pub points: Option<usize>,
    /// As [`Dataset::notes`].
    pub notes: Vec<String>,
}

/// One posed photograph.
#[derive(Debug, Clone)]
pub struct Frame {
    /// The image's name as the layout states it, without a leading `./`: `test/r_0`, `images/0001.jpg`, `IMG_7.jpg`.
    pub name: String,
    /// The undistorted pinhole camera.
    pub camera: Camera,
    /// Pixels of exactly the camera's size.
    pub image: Photograph,
    /// Which pixels count, in training as in every figure; all without one.
    pub mask: Option<PixelMask>,
    /// Train or test.
    pub split: Split,
}

/// A dataset camera, stored with a job's results so that views can be requested by frame name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NamedCamera {
    /// Frame name.
    pub name: String,
    /// Train or test.
    pub split: Split,
    /// Its pinhole camera.
    pub camera: Camera,
}

impl NamedCamera {
    /// The camera that shows a scene where none is asked for: the first held-out one, else the first.
    #[must_use]
    pub fn first_to_show(cameras: &[Self]) -> Option<&Self> {
        cameras.iter().find(|camera| camera.split == Split::Test).or_else(|| cameras.first())
    }
}

/// Structure-from-motion points in the frames' world.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// World positions.
    pub positions: Vec<[f64; 3]>,
    /// sRGB colors, as many as positions.
    pub colors: Vec<[u8; 3]>,
}

/// A dataset that passed every check.
#[derive(Debug, Clone)]
pub struct Dataset {
    /// Which reader produced it.
    pub layout: Layout,
    /// Train and test frames.
    pub frames: Vec<Frame>,
    /// The point cloud, if the dataset has one.
    pub points: Option<PointCloud>,
    /// SHA-256 over the content that was read (names and bytes in name order), independent of zip or directory.
    pub digest: Digest,
    /// Warnings that did not stop the job ("3 images are not listed in transforms.json").
    pub notes: Vec<String>,
}

impl Dataset {
    /// Frames of one split, in order.
    pub fn split(&self, split: Split) -> impl Iterator<Item = &Frame> {
        self.frames.iter().filter(move |frame| frame.split == split)
    }

    /// Bytes of the photographs in memory, with their masks.
    #[must_use]
    pub fn bytes_in_memory(&self) -> u64 {
        let mask = |frame: &Frame| frame.mask.as_ref().map_or(0, PixelMask::bytes_in_memory);
        self.frames.iter().map(|frame| frame.image.bytes_in_memory() + mask(frame)).sum()
    }

    /// The frame called `name`, as [`find_name`] finds it.
    #[must_use]
    pub fn find_frame(&self, name: &str) -> Option<&Frame> {
        let names: Vec<&str> = self.frames.iter().map(|frame| frame.name.as_str()).collect();
        find_name(&names, name).map(|index| &self.frames[index])
    }
}

/// The index of `wanted` in `names`: by exact name, else by name without extension, else by file stem. What more than one name
/// answers to names nothing.
#[must_use]
pub fn find_name(names: &[&str], wanted: &str) -> Option<usize> {
    let wanted = wanted.trim_start_matches("./");
    let only = |matches: &dyn Fn(&str) -> bool| {
        let mut found = names.iter().enumerate().filter(|(_, name)| matches(name));
        match (found.next(), found.next()) {
            (Some((index, _)), None) => Some(index),
            _ => None,
        }
    };
    let bare = without_extension(wanted);
    let exact = names.iter().position(|name| *name == wanted);
    exact
        .or_else(|| only(&|name| without_extension(name) == bare))
        .or_else(|| only(&|name| stem(name) == bare))
}

/// A name without the extension of an image file; what follows another dot belongs to the name.
#[must_use]
pub fn without_extension(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((bare, extension))
            if !bare.is_empty()
                && !bare.ends_with('/')
                && IMAGE_EXTENSIONS.iter().any(|known| extension.eq_ignore_ascii_case(known)) =>
        {
            bare
        }
        _ => name,
    }
}

fn stem(name: &str) -> &str {
    let bare = without_extension(name);
    bare.rfind('/').map_or(bare, |slash| &bare[slash + 1..])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_found_by_name_bare_name_or_unique_stem() {
        let names = ["train/r_0", "test/r_0", "images/0001.jpg"];
        assert_eq!(find_name(&names, "test/r_0"), Some(1));
        assert_eq!(find_name(&names, "./test/r_0.png"), Some(1));
        assert_eq!(find_name(&names, "images/0001"), Some(2));
        assert_eq!(find_name(&names, "0001"), Some(2));
        assert_eq!(find_name(&names, "r_0"), None, "an ambiguous stem names nothing");
        assert_eq!(find_name(&names, "r_9"), None);
        let numbered = ["clip.0001", "clip.0002", "a.png", "a.jpg", "b/v1.5.JPG"];
        assert_eq!(find_name(&numbered, "clip.0002.png"), Some(1));
        assert_eq!(find_name(&numbered, "a.jpg"), Some(3));
        assert_eq!(find_name(&numbered, "v1.5"), Some(4));
        for ambiguous_or_absent in ["clip.9999", "clip", "a", "a.webp", "v1"] {
            assert_eq!(find_name(&numbered, ambiguous_or_absent), None, "{ambiguous_or_absent}");
        }
    }
}
