//! Stored images: their size from the header alone, and their pixels as 8-bit RGB or RGBA.
//!
//! A size is known and judged before any pixel is decoded, and the decoder may not allocate more than the
//! largest accepted image needs.

use std::io::Cursor;

use image::{DynamicImage, ImageDecoder, ImageReader};

use super::{
    error::{Error, Fault},
    limits::Limits,
    tree::Tree,
};
use crate::domain::{Image, camera::MAX_IMAGE_SIDE};

/// How much of a file is tried first for its header; a photograph's preview and profiles rarely need more.
const HEADER_BYTES: u64 = 64 << 10;

/// Extensions of the formats that are read, lower case.
pub(super) const EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// Bytes a pixel of the widest pixel format that is decoded (16-bit RGBA).
const WIDEST_PIXEL: u64 = 8;

/// Whether a name has the extension of an image.
pub(super) fn is_image_name(name: &str) -> bool {
    name.rsplit_once('.')
        .is_some_and(|(_, extension)| EXTENSIONS.iter().any(|e| extension.eq_ignore_ascii_case(e)))
}

/// What the header of a stored image says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Header {
    /// Width and height.
    pub(super) size: (u32, u32),
    /// Whether pixels may be transparent.
    pub(super) alpha: bool,
}

/// The header of a stored image.
///
/// # Errors
/// [`Fault::Image`], [`Fault::TooManyPixels`], or a fault of reading the file.
pub(super) fn header(tree: &Tree, name: &str, limits: &Limits) -> Result<Header, Error> {
    let head = tree.read_up_to(name, HEADER_BYTES)?;
    let header = match header_of(&head, limits) {
        // The header may simply be longer: some cameras embed large previews before the image.
        Err(_) if head.len() as u64 == HEADER_BYTES => {
            header_of(&tree.read_up_to(name, limits.file_bytes)?, limits)
        }
        known => known,
    }
    .map_err(|fault| fault.at(name))?;
    let (width, height) = header.size;
    let pixels = u64::from(width) * u64::from(height);
    if pixels > limits.image_pixels {
        return Err(Fault::TooManyPixels { pixels, limit: limits.image_pixels }.at(name));
    }
    Ok(header)
}

/// Decodes an image of the size that its header promised. 16-bit and grey images become 8-bit colour; alpha is
/// kept where any pixel is not opaque.
///
/// # Errors
/// [`Fault::Image`].
pub(super) fn decode(bytes: &[u8], limits: &Limits) -> Result<Image, Fault> {
    if bytes.starts_with(&[0xff, 0xd8]) && !jpeg_is_complete(bytes) {
        return Err(Fault::Image("the JPEG data ends early".to_owned()));
    }
    let decoded = DynamicImage::from_decoder(decoder(bytes, limits)?).map_err(unreadable)?;
    let (width, height) = (decoded.width(), decoded.height());
    let (channels, samples) = if decoded.color().has_alpha() {
        let rgba = decoded.into_rgba8();
        if rgba.pixels().all(|pixel| pixel[3] == u8::MAX) {
            (3, DynamicImage::from(rgba).into_rgb8().into_raw())
        } else {
            (4, rgba.into_raw())
        }
    } else {
        (3, decoded.into_rgb8().into_raw())
    };
    Image::new(width, height, channels, samples).map_err(|error| Fault::Image(error.to_string()))
}

fn header_of(bytes: &[u8], limits: &Limits) -> Result<Header, Fault> {
    let decoder = decoder(bytes, limits)?;
    Ok(Header { size: decoder.dimensions(), alpha: decoder.color_type().has_alpha() })
}

fn decoder<'a>(bytes: &'a [u8], limits: &Limits) -> Result<impl ImageDecoder + 'a, Fault> {
    let mut allowed = image::Limits::no_limits();
    allowed.max_image_width = Some(MAX_IMAGE_SIDE);
    allowed.max_image_height = Some(MAX_IMAGE_SIDE);
    allowed.max_alloc = Some(limits.image_pixels.saturating_mul(WIDEST_PIXEL).max(WIDEST_PIXEL << 20));
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|error| Fault::Image(error.to_string()))?;
    reader.limits(allowed);
    reader.into_decoder().map_err(unreadable)
}

fn unreadable(error: image::ImageError) -> Fault {
    Fault::Image(error.to_string())
}

/// Whether an end-of-image marker follows the first scan. The decoder fills what is missing from a shortened
/// JPEG with grey and does not say so; training on such pixels would be worse than refusing them.
fn jpeg_is_complete(bytes: &[u8]) -> bool {
    const START_OF_SCAN: u8 = 0xda;
    let mut at = 2;
    while let Some([0xff, marker, rest @ ..]) = bytes.get(at..) {
        match (*marker, rest) {
            (0xff, _) => at += 1,
            (START_OF_SCAN, _) => return rest.windows(2).any(|pair| pair == [0xff, 0xd9]),
            (_, [high, low, ..]) => at += 2 + usize::from(u16::from_be_bytes([*high, *low])),
            _ => return false,
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use image::{ImageBuffer, ImageFormat, Luma, Rgb, Rgba};

    use super::*;

    fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.into().write_to(&mut bytes, format).expect("encodes");
        bytes.into_inner()
    }

    #[test]
    fn every_pixel_format_becomes_8_bit_colour() {
        let limits = Limits::default();
        let deep = ImageBuffer::from_pixel(2, 1, Rgb([0x8000_u16, 0xffff, 0]));
        let grey = ImageBuffer::from_pixel(2, 1, Luma([77_u8]));
        let clear = ImageBuffer::from_pixel(2, 1, Rgba([1_u8, 2, 3, 4]));
        let opaque = ImageBuffer::from_pixel(2, 1, Rgba([1_u8, 2, 3, 255]));
        for (bytes, channels, samples) in [
            (encoded(deep, ImageFormat::Png), 3, [128_u8, 255, 0].repeat(2)),
            (encoded(grey.clone(), ImageFormat::Png), 3, vec![77; 6]),
            (encoded(grey, ImageFormat::WebP), 3, vec![77; 6]),
            (encoded(clear, ImageFormat::Png), 4, [1, 2, 3, 4].repeat(2)),
            (encoded(opaque, ImageFormat::Png), 3, [1, 2, 3].repeat(2)),
        ] {
            let header = header_of(&bytes, &limits).expect("a header");
            assert_eq!(header.size, (2, 1));
            assert!(header.alpha || channels == 3, "what has no alpha by its header gets none");
            let image = decode(&bytes, &limits).expect("decodes");
            assert_eq!((image.channels(), image.samples()), (channels, samples.as_slice()));
        }
    }

    #[test]
    fn no_shortened_image_is_accepted_and_none_panics() {
        let noise = ImageBuffer::from_fn(24, 16, |x, y| {
            Rgb([(x * 37 + y * 91) as u8, (x * y * 7) as u8, (x * 5 + y * 3) as u8])
        });
        for format in [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::WebP] {
            let bytes = encoded(noise.clone(), format);
            let limits = Limits::default();
            assert!(decode(&bytes, &limits).is_ok());
            // The last bytes of a PNG are an empty chunk and those of a WebP padding: they hold no pixels.
            let needed = bytes.len() - if format == ImageFormat::Jpeg { 0 } else { 12 };
            for length in 0..needed {
                assert!(decode(&bytes[..length], &limits).is_err(), "{format:?} cut at {length}");
            }
        }
    }

    #[test]
    fn a_header_cannot_make_the_decoder_allocate_without_bound() {
        let small = Limits { image_pixels: 1, ..Limits::default() };
        // A valid PNG header that claims 60000 x 60000 pixels.
        let mut claims = encoded(ImageBuffer::from_pixel(1, 1, Rgb([0_u8; 3])), ImageFormat::Png);
        claims[16..24].copy_from_slice(&[0, 0, 0xea, 0x60, 0, 0, 0xea, 0x60]);
        assert!(decode(&claims, &small).is_err());
        assert!(decode(&claims, &Limits::default()).is_err());
    }

    #[test]
    fn image_names_are_known_by_extension_in_any_case() {
        assert!(is_image_name("images/A.JPG") && is_image_name("a.webp") && is_image_name("a.b.jpeg"));
        assert!(!is_image_name("images/a") && !is_image_name("png") && !is_image_name("a.json"));
    }
}
