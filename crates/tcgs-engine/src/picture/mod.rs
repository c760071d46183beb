//! Pictures as files: JPEG, PNG and WebP, by one encoder each for the service, the command line and reports.
//!
//! Invariants: the same image and settings give the same bytes on every machine, whatever the number of threads, and
//! [`PictureFormat::encoder`] changes with everything else that decides them.

mod apng;
mod jpeg;
mod png;
mod webp_animation;

use image::{ExtendedColorType, ImageEncoder as _, ImageError, codecs::webp::WebPEncoder};
use thiserror::Error;

pub use self::{apng::Apng, webp_animation::WebpAnimation};
use crate::domain::Image;

/// Why a picture is not encoded.
#[derive(Debug, Error)]
pub enum PictureError {
    /// The JPEG encoder's error.
    #[error("the JPEG encoder failed: {0}")]
    Jpeg(#[from] jpeg_encoder::EncodingError),
    /// The encoder's error of lossy WebP.
    #[error("the WebP encoder failed: {0}")]
    Webp(String),
    /// The encoder wrote a file without the named part.
    #[error("the encoder wrote a file without {0}")]
    Incomplete(&'static str),
    /// The encoder's error of the other formats.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// A frame of an animation is of another size, or is no whole file of its format.
    #[error("frame {0} of an animation is no picture of its size")]
    Frame(u32),
    /// More bytes than a file of the format may have.
    #[error("the animation is too long for its format")]
    TooLong,
}

/// A file format, with its settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PictureFormat {
    /// JPEG of this quality, 1 to 100, without chroma subsampling. Transparent pixels are composited over black.
    Jpeg {
        /// As libjpeg scales its tables.
        quality: u8,
    },
    /// PNG at a fast level of compression.
    Png,
    /// Lossless WebP.
    Webp,
    /// WebP of this quality, 1 to 100, with half of the chroma's resolution on each axis.
    LossyWebp {
        /// As libwebp scales its quantizers.
        quality: u8,
    },
}

impl PictureFormat {
    /// The encoder's name, version and settings.
    #[must_use]
    pub fn encoder(self) -> &'static str {
        match self {
            Self::Jpeg { .. } => "jpeg-encoder 0.7.1, 4:4:4, strips of 64 rows",
            Self::Png => "png 0.18.1, fast, adaptive filters",
            Self::Webp => "image-webp 0.2.4, lossless",
            Self::LossyWebp { .. } => "webp 0.3.1, 4:2:0",
        }
    }

    /// The file of an RGB or RGBA image. Uses rayon's threads for JPEG.
    ///
    /// # Errors
    /// [`PictureError`] of the encoder.
    pub fn encode(self, image: &Image) -> Result<Vec<u8>, PictureError> {
        match self {
            Self::Jpeg { quality } => jpeg::encode(image, quality),
            Self::Png => png::encode(image.samples(), image.width(), image.height(), color(image)),
            Self::Webp => {
                let mut file = Vec::new();
                let (width, height) = (image.width(), image.height());
                WebPEncoder::new_lossless(&mut file).write_image(
                    image.samples(),
                    width,
                    height,
                    color(image),
                )?;
                Ok(file)
            }
            Self::LossyWebp { quality } => lossy_webp(image, quality),
        }
    }
}

fn lossy_webp(image: &Image, quality: u8) -> Result<Vec<u8>, PictureError> {
    let (width, height) = (image.width(), image.height());
    let encoder = match image.channels() {
        3 => webp::Encoder::from_rgb(image.samples(), width, height),
        _ => webp::Encoder::from_rgba(image.samples(), width, height),
    };
    let file = encoder.encode_simple(false, f32::from(quality));
    file.map(|file| file.to_vec()).map_err(|error| PictureError::Webp(format!("{error:?}")))
}

/// PNG of one channel: 8-bit samples.
///
/// # Errors
/// [`PictureError::Image`].
pub fn gray_png(samples: &[u8], width: u32, height: u32) -> Result<Vec<u8>, PictureError> {
    png::encode(samples, width, height, ExtendedColorType::L8)
}

/// PNG of one channel: 16-bit samples.
///
/// # Errors
/// [`PictureError::Image`].
pub fn deep_gray_png(samples: &[u16], width: u32, height: u32) -> Result<Vec<u8>, PictureError> {
    png::encode(bytemuck::cast_slice(samples), width, height, ExtendedColorType::L16)
}

fn color(image: &Image) -> ExtendedColorType {
    if image.channels() == 3 { ExtendedColorType::Rgb8 } else { ExtendedColorType::Rgba8 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn encoders_are_named_with_the_versions_that_are_built() {
        let lock = include_str!("../../../../Cargo.lock");
        for format in [
            PictureFormat::Jpeg { quality: 90 },
            PictureFormat::Png,
            PictureFormat::Webp,
            PictureFormat::LossyWebp { quality: 80 },
        ] {
            let (name, rest) = format.encoder().split_once(' ').expect("a name and a version");
            let version = rest.split(',').next().expect("a version");
            let package = format!("name = \"{name}\"\nversion = \"{version}\"\n");
            assert!(lock.contains(&package), "Cargo.lock has another {name} than {version}");
        }
    }

    #[test]
    fn lossy_webp_is_near_the_picture_and_nearer_at_a_higher_quality() {
        let samples: Vec<u8> =
            (0..64 * 48 * 3).map(|i| ((i / 3 % 64) * 3 + (i / 192) * (1 + i % 3)) as u8).collect();
        let image = Image::new(64, 48, 3, samples).expect("an image");
        let [(coarse, far), (fine, near)] = [20, 95].map(|quality| {
            let file = PictureFormat::LossyWebp { quality }.encode(&image).expect("encodes");
            let decoder = image::codecs::webp::WebPDecoder::new(std::io::Cursor::new(&file)).expect("a WebP");
            let mut decoded = vec![0; image.samples().len()];
            image::ImageDecoder::read_image(decoder, &mut decoded).expect("reads");
            let errors = decoded.iter().zip(image.samples()).map(|(a, b)| u64::from(a.abs_diff(*b)).pow(2));
            (file.len(), errors.sum::<u64>() / decoded.len() as u64)
        });
        assert!(coarse < fine && near < far && near < 100, "{coarse} {far}, {fine} {near}");
    }
}
