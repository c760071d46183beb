//! The bundled scene: a small ray-traced still life, to try everything without photographs of one's own.
//!
//! It has what makes photographs hard: fine texture, sharp and soft shadows, a highlight that moves with the camera, wires about a pixel
//! wide, and a background that is far but not at infinity. The bytes are a function of [`Settings`] alone: every transcendental function
//! comes from `libm` and every random number from a seeded generator, so each machine writes the same files.

mod files;
mod points;
mod scene;
mod shape;
mod texture;
mod views;

use std::{io, path::PathBuf};

use thiserror::Error;

pub use files::{write, write_watched};

/// Size and seed of the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// Width and height of each image in pixels.
    pub side: u32,
    /// Points in the cloud.
    pub points: usize,
    /// Seed of the cloud's choice of points and of their jitter.
    pub seed: u64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { side: 200, points: 5000, seed: 1 }
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
    #[error("images of {0} pixels a side are outside 8..=4096")]
    Side(u32),
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
    /// The zip could not be put together.
    #[error("the zip could not be written: {0}")]
    Zip(#[from] zip::result::ZipError),
}
