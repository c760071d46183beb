//! A photograph of a dataset, in memory or stored.
//!
//! A dataset may be larger than memory, so a frame holds a handle: the pixels are in memory, or a [`PixelSource`] reads them on demand.
//! Both give the same bits.

use std::{fmt, sync::Arc};

use thiserror::Error;

use super::{Image, ImageError, Problem};
use crate::domain::ProblemType;

/// Stored pixels that cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum PhotographError {
    /// The storage cannot be read.
    #[error("the pixels of a photograph cannot be read back: {0}")]
    Unreadable(String),
    /// The stored data is not an image of the photograph's size.
    #[error("the pixels of a photograph were read back damaged: {0}")]
    Damaged(#[from] ImageError),
}

impl From<PhotographError> for Problem {
    fn from(error: PhotographError) -> Self {
        Problem::new(ProblemType::PhotographLost, error.to_string())
    }
}

/// Keeps the pixels of one image outside of memory.
pub trait PixelSource: fmt::Debug + Send + Sync {
    /// All samples, row by row, as many as were stored.
    ///
    /// # Errors
    /// [`PhotographError::Unreadable`].
    fn samples(&self) -> Result<Vec<u8>, PhotographError>;
}

/// An image that is in memory or can be read. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Photograph {
    width: u32,
    height: u32,
    channels: u8,
    pixels: Pixels,
}

#[derive(Debug, Clone)]
enum Pixels {
    InMemory(Arc<Image>),
    Stored(Arc<dyn PixelSource>),
}

impl Photograph {
    /// An image of `shape` (width, height, channels) whose pixels `source` keeps.
    #[must_use]
    pub fn stored(shape: (u32, u32, u8), source: Arc<dyn PixelSource>) -> Self {
        let (width, height, channels) = shape;
        Self { width, height, channels, pixels: Pixels::Stored(source) }
    }

    /// Width in pixels.
    #[must_use]
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height in pixels.
    #[must_use]
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Whether it has alpha.
    #[must_use]
    pub fn has_alpha(&self) -> bool {
        self.channels == 4
    }

    /// The pixels.
    ///
    /// # Errors
    /// [`PhotographError`] where they are not in memory and cannot be read.
    pub fn load(&self) -> Result<Arc<Image>, PhotographError> {
        match &self.pixels {
            Pixels::InMemory(image) => Ok(Arc::clone(image)),
            Pixels::Stored(source) => {
                Ok(Arc::new(Image::new(self.width, self.height, self.channels, source.samples()?)?))
            }
        }
    }

    /// Bytes of its 8-bit samples.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height) * u64::from(self.channels)
    }

    /// Bytes of memory that it holds while it is not loaded.
    #[must_use]
    pub fn bytes_in_memory(&self) -> u64 {
        match self.pixels {
            Pixels::InMemory(_) => self.bytes(),
            Pixels::Stored(_) => 0,
        }
    }
}

impl From<Image> for Photograph {
    fn from(image: Image) -> Self {
        Self {
            width: image.width(),
            height: image.height(),
            channels: image.channels(),
            pixels: Pixels::InMemory(Arc::new(image)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug)]
    struct Put(Result<Vec<u8>, PhotographError>);

    impl PixelSource for Put {
        fn samples(&self) -> Result<Vec<u8>, PhotographError> {
            self.0.clone()
        }
    }

    #[test]
    fn a_photograph_gives_the_same_image_from_wherever_it_is() {
        let image = Image::new(2, 1, 3, vec![1, 2, 3, 4, 5, 6]).expect("an image");
        let here = Photograph::from(image.clone());
        let there = Photograph::stored((2, 1, 3), Arc::new(Put(Ok(image.samples().to_vec()))));
        assert_eq!(*here.load().expect("in memory"), image);
        assert_eq!(*there.load().expect("stored"), image);
        assert_eq!((here.bytes(), here.bytes_in_memory()), (6, 6));
        assert_eq!((there.bytes(), there.bytes_in_memory()), (6, 0));
    }

    #[test]
    fn pixels_that_are_gone_or_too_few_are_an_error() {
        let gone = PhotographError::Unreadable("gone".to_owned());
        let photograph = Photograph::stored((2, 1, 3), Arc::new(Put(Err(gone.clone()))));
        assert_eq!(photograph.load(), Err(gone));
        let photograph = Photograph::stored((2, 1, 3), Arc::new(Put(Ok(vec![0; 5]))));
        assert!(matches!(photograph.load(), Err(PhotographError::Damaged(_))));
    }
}
