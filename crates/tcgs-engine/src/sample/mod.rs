//! The bundled scene: a small ray-traced still life, to try everything without photographs of one's own.
//!
//! It has what makes photographs hard: fine texture, sharp and soft shadows, a highlight that moves with the camera, wires about a pixel
//! wide, and a background that is far but not at infinity. The bytes are a function of [`Settings`] alone: every transcendental function
//! comes from `libm` and every random number from a seeded generator, so each machine writes the same files.

mod files;
mod output;
mod points;
mod scene;
mod shape;
mod texture;
mod video;
mod views;

use std::{io, path::PathBuf};

use thiserror::Error;

pub use files::{write, write_watched};
pub use video::write_video;

/// Sides of an image, in pixels.
const SIDES: std::ops::RangeInclusive<u32> = 8..=4096;
/// Views around the scene.
const VIEWS: std::ops::RangeInclusive<usize> = 6..=2000;

/// Size, views and seed of the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// Width of each image in pixels.
    pub width: u32,
    /// Height of each image in pixels.
    pub height: u32,
    /// Images.
    pub views: usize,
    /// Points in the cloud.
    pub points: usize,
    /// Seed of the cloud's choice of points and of their jitter.
    pub seed: u64,
    /// Photographs as JPEG files alone, as from a camera: without poses, points and held-out views.
    pub is_bare: bool,
}

impl Settings {
    /// The scene in square images of `side` pixels.
    #[must_use]
    pub const fn square(side: u32) -> Self {
        Self { width: side, height: side, views: 48, points: 5000, seed: 1, is_bare: false }
    }

    fn check(&self) -> Result<(), SampleError> {
        if !SIDES.contains(&self.width) || !SIDES.contains(&self.height) {
            return Err(SampleError::Size(self.width, self.height));
        }
        if !VIEWS.contains(&self.views) {
            return Err(SampleError::Views(self.views));
        }
        Ok(())
    }
}

impl Default for Settings {
    fn default() -> Self {
        Self::square(200)
    }
}

/// Counts of what was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SampleCounts {
    /// Images to train on.
    pub train: usize,
    /// Images held out.
    pub test: usize,
    /// Points in the cloud.
    pub points: usize,
}

/// Why the scene could not be written.
#[derive(Debug, Error)]
pub enum SampleError {
    /// The folder holds something already, which is not to be mixed with the scene.
    #[error("{} is not empty; name a folder that is new or empty", .0.display())]
    NotEmpty(PathBuf),
    /// There is a file of that name.
    #[error("{} exists already", .0.display())]
    Exists(PathBuf),
    /// The images would be empty or absurdly large.
    #[error("images of {0}x{1} pixels have a side outside {low}..={high}", low = SIDES.start(), high = SIDES.end())]
    Size(u32, u32),
    /// A video has colors at half its size.
    #[error("frames of {0}x{1} pixels have an odd side; a video needs even ones")]
    OddSize(u32, u32),
    /// Too few views to hold one out, or absurdly many.
    #[error("{0} views are outside {low}..={high}", low = VIEWS.start(), high = VIEWS.end())]
    Views(usize),
    /// The file system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// An image could not be encoded.
    #[error("an image could not be encoded: {0}")]
    Png(#[from] image::ImageError),
    /// A photograph could not be encoded.
    #[error("a photograph could not be encoded: {0}")]
    Jpeg(#[from] jpeg_encoder::EncodingError),
    /// ffmpeg cannot be run.
    #[error("a video needs ffmpeg ({}), which cannot be run: {source}; on Debian: apt-get install ffmpeg", program.display())]
    NoFfmpeg {
        /// The program.
        program: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// ffmpeg failed.
    #[error("ffmpeg could not write the video: {0}")]
    Ffmpeg(String),
    /// The zip could not be put together.
    #[error("the zip could not be written: {0}")]
    Zip(#[from] zip::result::ZipError),
}
