//! Rendered images as files.

use std::{io::Cursor, str::FromStr};

use bytes::Bytes;
use image::{
    ExtendedColorType, ImageEncoder as _, ImageError,
    codecs::{jpeg::JpegEncoder, png::PngEncoder, webp::WebPEncoder},
};
use serde::Deserialize;

use crate::domain::Image;

const JPEG_QUALITY: u8 = 90;

/// A file format for views. PNG and WebP are lossless.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Format {
    #[default]
    Png,
    Jpeg,
    Webp,
}

impl Format {
    pub(super) fn media_type(self) -> &'static str {
        match self {
            Format::Png => "image/png",
            Format::Jpeg => "image/jpeg",
            Format::Webp => "image/webp",
        }
    }

    pub(super) fn extension(self) -> &'static str {
        match self {
            Format::Png => "png",
            Format::Jpeg => "jpg",
            Format::Webp => "webp",
        }
    }
}

impl FromStr for Format {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        match text {
            "png" => Ok(Format::Png),
            "jpeg" => Ok(Format::Jpeg),
            "webp" => Ok(Format::Webp),
            _ => Err(()),
        }
    }
}

/// Writes an image in a format. JPEG has no alpha; a transparent pixel becomes what it is over black.
pub(super) fn encode(image: &Image, format: Format) -> Result<Bytes, ImageError> {
    let flat;
    let image = match format {
        Format::Jpeg => {
            flat = image.over([0; 3]);
            &flat
        }
        Format::Png | Format::Webp => image,
    };
    let color = if image.channels() == 3 { ExtendedColorType::Rgb8 } else { ExtendedColorType::Rgba8 };
    let (samples, width, height) = (image.samples(), image.width(), image.height());
    let mut file = Cursor::new(Vec::new());
    match format {
        Format::Png => PngEncoder::new(&mut file).write_image(samples, width, height, color)?,
        Format::Jpeg => {
            JpegEncoder::new_with_quality(&mut file, JPEG_QUALITY)
                .write_image(samples, width, height, color)?;
        }
        Format::Webp => WebPEncoder::new_lossless(&mut file).write_image(samples, width, height, color)?,
    }
    Ok(file.into_inner().into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_format_reads_back_and_the_lossless_ones_exactly() {
        for channels in [3, 4] {
            let samples: Vec<u8> = (0..5 * 3 * channels).map(|i| (i * 7 % 256) as u8).collect();
            let image = Image::new(5, 3, channels as u8, samples.clone()).expect("an image");
            for format in [Format::Png, Format::Jpeg, Format::Webp] {
                let file = encode(&image, format).expect("encodes");
                let guessed = image::guess_format(&file).expect("a known format");
                assert_eq!(guessed.to_mime_type(), format.media_type());
                let back = image::load_from_memory(&file).expect("decodes");
                assert_eq!((back.width(), back.height()), (5, 3));
                if format != Format::Jpeg {
                    assert_eq!(back.as_bytes(), samples, "{format:?} with {channels} channels");
                }
            }
        }
    }
}
