//! 8-bit images in memory, rows from the top, channels interleaved.
//!
//! The sample count always matches `width * height * channels`.

use thiserror::Error;

use super::camera::MAX_IMAGE_SIDE;

/// What can be wrong with an image's shape.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum ImageError {
    /// A side is zero or too long.
    #[error("the image size {width}x{height} is outside 1..={MAX_IMAGE_SIDE} pixels per side")]
    Size {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// Neither RGB nor RGBA.
    #[error("an image needs 3 or 4 channels, not {0}")]
    Channels(u8),
    /// The sample count does not match the shape.
    #[error("{actual} samples given where {expected} are needed")]
    Samples {
        /// `width * height * channels`.
        expected: usize,
        /// The length given.
        actual: usize,
    },
}

/// An 8-bit sRGB image with 3 (RGB) or 4 (RGB and straight, not premultiplied, alpha) channels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image {
    width: u32,
    height: u32,
    channels: u8,
    samples: Vec<u8>,
}

impl Image {
    /// An image from its samples.
    ///
    /// # Errors
    /// [`ImageError`] if the shape is impossible or the samples do not fill it exactly.
    pub fn new(width: u32, height: u32, channels: u8, samples: Vec<u8>) -> Result<Self, ImageError> {
        let sides = 1..=MAX_IMAGE_SIDE;
        if !sides.contains(&width) || !sides.contains(&height) {
            return Err(ImageError::Size { width, height });
        }
        if channels != 3 && channels != 4 {
            return Err(ImageError::Channels(channels));
        }
        let expected = width as usize * height as usize * usize::from(channels);
        if samples.len() != expected {
            return Err(ImageError::Samples { expected, actual: samples.len() });
        }
        Ok(Self { width, height, channels, samples })
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

    /// 3 or 4.
    #[must_use]
    pub fn channels(&self) -> u8 {
        self.channels
    }

    /// All samples, row by row.
    #[must_use]
    pub fn samples(&self) -> &[u8] {
        &self.samples
    }

    /// The image over a constant background, as RGB. Straight alpha is composited in 8-bit sRGB values and
    /// floored, as other loaders do (METHOD.md §1.1). An RGB image is returned unchanged.
    #[must_use]
    pub fn over(&self, background: [u8; 3]) -> Image {
        if self.channels == 3 {
            return self.clone();
        }
        let mut samples = Vec::with_capacity(self.width as usize * self.height as usize * 3);
        for pixel in self.samples.chunks_exact(4) {
            let alpha = u32::from(pixel[3]);
            for channel in 0..3 {
                let mixed =
                    u32::from(pixel[channel]) * alpha + u32::from(background[channel]) * (255 - alpha);
                samples.push((mixed / 255) as u8);
            }
        }
        Image { width: self.width, height: self.height, channels: 3, samples }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn straight_alpha_is_composited_and_floored() {
        let image = Image::new(2, 1, 4, vec![200, 100, 0, 128, 10, 20, 30, 0]).expect("an image");
        assert_eq!(image.over([255, 255, 255]).samples(), &[227, 177, 127, 255, 255, 255]);
        assert_eq!(image.over([0, 0, 0]).samples(), &[100, 50, 0, 0, 0, 0]);
    }

    #[test]
    fn shapes_that_do_not_fit_are_refused() {
        assert_eq!(Image::new(0, 1, 3, vec![]), Err(ImageError::Size { width: 0, height: 1 }));
        assert_eq!(Image::new(1, 1, 2, vec![0, 0]), Err(ImageError::Channels(2)));
        assert_eq!(Image::new(1, 1, 3, vec![0]), Err(ImageError::Samples { expected: 3, actual: 1 }));
    }
}
