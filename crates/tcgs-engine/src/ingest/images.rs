//! Stored images: their size from the header alone, and their pixels as 8-bit RGB or RGBA.
//!
//! A size is checked before any pixel is decoded, from the beginning of the file only. The decoder may not allocate more than an
//! image of that size needs.

use std::io::{BufRead, Cursor, Read as _};

use image::{
    DynamicImage, ImageDecoder, ImageError, ImageReader, error::LimitErrorKind, metadata::Orientation,
};

use super::{
    error::{IngestError, IngestErrorKind, Result},
    formats,
    limits::Limits,
    tree::Tree,
};
use crate::domain::{Image, camera::MAX_IMAGE_SIDE, dataset::IMAGE_EXTENSIONS};

/// How much of a file is tried first for its header; a photograph's preview and profiles rarely need more.
const FIRST_BYTES: u64 = 64 << 10;

/// Bytes that a decoder may allocate besides pixels, for color profiles and the like.
const DECODER_BYTES: u64 = 4 << 20;

/// Bytes a pixel of the stored image that decoding takes at most: 16-bit RGBA beside its 8-bit copy, or 8-bit RGB beside what a
/// progressive JPEG keeps.
pub(super) const DECODE_BYTES: u64 = 12;

/// Bytes a pixel of the widest pixel format that is decoded (16-bit RGBA).
const MAX_PIXEL_BYTES: u64 = 8;

/// Whether a name has the extension of an image.
pub(super) fn is_image_name(name: &str) -> bool {
    name.rsplit_once('.')
        .is_some_and(|(_, extension)| IMAGE_EXTENSIONS.iter().any(|e| extension.eq_ignore_ascii_case(e)))
}

/// Most bytes of an EXIF block that are read; its orientation stands at the beginning.
const EXIF_BYTES: u64 = 64 << 10;

/// Size, transparency and orientation from the header of a stored image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Header {
    /// Width and height.
    pub(super) size: (u32, u32),
    /// Whether pixels may be transparent.
    pub(super) alpha: bool,
    /// How the EXIF orientation turns the stored pixels.
    pub(super) orientation: Orientation,
}

impl Header {
    fn pixels(&self) -> u64 {
        u64::from(self.size.0) * u64::from(self.size.1)
    }
}

/// Whether an orientation swaps width and height.
pub(super) fn swaps_sides(orientation: Orientation) -> bool {
    matches!(
        orientation,
        Orientation::Rotate90
            | Orientation::Rotate270
            | Orientation::Rotate90FlipH
            | Orientation::Rotate270FlipH
    )
}

/// The header of a stored image.
///
/// # Errors
/// [`IngestErrorKind::Image`], [`IngestErrorKind::ImageHeader`], [`IngestErrorKind::SideTooLong`], [`IngestErrorKind::TooManyPixels`], or a fault of reading the file.
pub(super) fn header(tree: &Tree, name: &str, limits: &Limits) -> Result<Header, IngestError> {
    let head = tree.read_up_to(name, FIRST_BYTES)?;
    let mut header = match header_of(&head) {
        // The header may simply be longer: some cameras embed large previews before the image.
        Err(_) if head.len() as u64 == FIRST_BYTES => {
            let head = tree.read_up_to(name, Limits::HEADER_BYTES)?;
            header_of(&head).map_err(|error| match error {
                IngestErrorKind::Image(message) if head.len() as u64 == Limits::HEADER_BYTES => {
                    IngestErrorKind::ImageHeader { limit: Limits::HEADER_BYTES, message }
                }
                other => other,
            })
        }
        known => known,
    }
    .map_err(|error| match (error, formats::by_content(&head)) {
        (IngestErrorKind::Image(_) | IngestErrorKind::ImageHeader { .. }, Some(format)) => {
            IngestErrorKind::UnreadFormat { format: format.name, remedy: format.remedy(name) }
        }
        (error, _) => error,
    })
    .map_err(|error| error.at(name))?;
    let pixels = header.pixels();
    if pixels > limits.image_pixels {
        return Err(IngestErrorKind::TooManyPixels { pixels, limit: limits.image_pixels }.at(name));
    }
    if webp_has_exif(&head) {
        // It stands behind the pixels.
        let orientation = tree.parse_unused(name, u64::MAX, |reader, _| Ok(webp_orientation(reader)))?.0;
        header.orientation = orientation.unwrap_or(header.orientation);
    }
    Ok(header)
}

fn webp_has_exif(head: &[u8]) -> bool {
    const EXIF: u8 = 0x08;
    extended_webp(head).is_some() && head[20] & EXIF != 0
}

/// The orientation in the EXIF chunk of a WebP file; `None` without one.
fn webp_orientation(reader: &mut dyn BufRead) -> Option<Orientation> {
    let mut riff = [0; 12];
    reader.read_exact(&mut riff).ok()?;
    loop {
        let mut chunk = [0; 8];
        reader.read_exact(&mut chunk).ok()?;
        let length = u64::from(u32::from_le_bytes([chunk[4], chunk[5], chunk[6], chunk[7]]));
        if chunk.starts_with(b"EXIF") {
            let mut exif = Vec::new();
            reader.take(length.min(EXIF_BYTES)).read_to_end(&mut exif).ok()?;
            return Orientation::from_exif_chunk(exif.strip_prefix(b"Exif\0\0").unwrap_or(&exif));
        }
        // Chunks have an even length.
        let padded = length + length % 2;
        if std::io::copy(&mut (&mut *reader).take(padded), &mut std::io::sink()).ok()? < padded {
            return None;
        }
    }
}

/// Decodes an image of the size that its header promised and turns it. 16-bit and gray images become 8-bit color; alpha is
/// kept where any pixel is not opaque.
///
/// # Errors
/// [`IngestErrorKind::Image`].
pub(super) fn decode(bytes: &[u8], turn: Orientation, limits: &Limits) -> Result<Image> {
    if bytes.starts_with(&[0xff, 0xd8]) && !jpeg_is_complete(bytes) {
        return Err(IngestErrorKind::Image("the JPEG data ends early".to_owned()));
    }
    let pixels = header_of(bytes)?.pixels();
    if pixels > limits.image_pixels {
        return Err(IngestErrorKind::TooManyPixels { pixels, limit: limits.image_pixels });
    }
    let decoder = decoder(bytes, pixels * MAX_PIXEL_BYTES + DECODER_BYTES)?;
    let decoded = DynamicImage::from_decoder(decoder).map_err(unreadable)?;
    let mut image = if decoded.color().has_alpha() {
        let rgba = decoded.into_rgba8();
        if rgba.pixels().all(|pixel| pixel[3] == u8::MAX) {
            DynamicImage::from(DynamicImage::from(rgba).into_rgb8())
        } else {
            rgba.into()
        }
    } else {
        decoded.into_rgb8().into()
    };
    image.apply_orientation(turn);
    let (width, height, channels) = (image.width(), image.height(), image.color().channel_count());
    Image::new(width, height, channels, image.into_bytes())
        .map_err(|error| IngestErrorKind::Image(error.to_string()))
}

fn header_of(bytes: &[u8]) -> Result<Header> {
    if let Some(header) = extended_webp(bytes) {
        return Ok(header);
    }
    let mut decoder = decoder(bytes, DECODER_BYTES)?;
    // Broken metadata turn nothing.
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok(Header { size: decoder.dimensions(), alpha: decoder.color_type().has_alpha(), orientation })
}

/// The canvas of an extended WebP file, whose decoder looks for metadata behind the pixels before it reports a size.
fn extended_webp(bytes: &[u8]) -> Option<Header> {
    const ALPHA: u8 = 0x10;
    let head: &[u8; 30] = bytes.first_chunk()?;
    if !(head.starts_with(b"RIFF") && head[8..16] == *b"WEBPVP8X") {
        return None;
    }
    let side = |at: usize| 1 + u32::from_le_bytes([head[at], head[at + 1], head[at + 2], 0]);
    let size = (side(24), side(27));
    let fits = size.0.max(size.1) <= MAX_IMAGE_SIDE;
    let orientation = Orientation::NoTransforms;
    fits.then_some(Header { size, alpha: head[20] & ALPHA != 0, orientation })
}

fn decoder(bytes: &[u8], most_bytes: u64) -> Result<impl ImageDecoder + '_> {
    let mut allowed = image::Limits::no_limits();
    allowed.max_image_width = Some(MAX_IMAGE_SIDE);
    allowed.max_image_height = Some(MAX_IMAGE_SIDE);
    allowed.max_alloc = Some(most_bytes);
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|error| IngestErrorKind::Image(error.to_string()))?;
    reader.limits(allowed);
    reader.into_decoder().map_err(unreadable)
}

/// The decoder's words in one line.
fn unreadable(error: image::ImageError) -> IngestErrorKind {
    if let ImageError::Limits(limit) = &error
        && matches!(limit.kind(), LimitErrorKind::DimensionError)
    {
        return IngestErrorKind::SideTooLong { limit: MAX_IMAGE_SIDE };
    }
    let words = error.to_string();
    IngestErrorKind::Image(words.split_whitespace().collect::<Vec<_>>().join(" "))
}

/// Whether an end-of-image marker follows the first scan. The decoder fills what is missing from a shortened
/// JPEG with gray and does not say so; training on such pixels would be worse than refusing them.
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

    const UPRIGHT: Orientation = Orientation::NoTransforms;

    /// An EXIF block with nothing but an orientation.
    fn exif(orientation: u8) -> Vec<u8> {
        let mut block = b"MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
        block.extend([orientation, 0, 0, 0, 0, 0, 0]);
        block
    }

    #[test]
    fn orientations_are_read_from_every_format() {
        let image = ImageBuffer::from_pixel(2, 1, Rgb([9_u8; 3]));
        for orientation in 1..=8 {
            let expected = Orientation::from_exif(orientation).expect("an orientation");
            let exif = exif(orientation);
            let mut jpeg = encoded(image.clone(), ImageFormat::Jpeg);
            let segment = [&[0xff, 0xe1, 0, 8 + exif.len() as u8], &b"Exif\0\0"[..], &exif].concat();
            jpeg.splice(2..2, segment);
            assert_eq!(header_of(&jpeg).expect("a header").orientation, expected);
            let webp = [
                &b"RIFF\0\0\0\0WEBPVP8X\x0a\0\0\0\x08\0\0\0\x01\0\0\0\0\0ALPH\x03\0\0\0abc\0EXIF"[..],
                &(exif.len() as u32).to_le_bytes(),
                &exif,
            ]
            .concat();
            assert!(webp_has_exif(&webp));
            assert_eq!(webp_orientation(&mut &*webp), Some(expected));
            for length in 0..webp.len() - exif.len() {
                assert_eq!(webp_orientation(&mut &webp[..length]), None);
            }
        }
        assert_eq!(header_of(&encoded(image, ImageFormat::Png)).expect("a header").orientation, UPRIGHT);
    }

    #[test]
    fn decoded_images_are_turned() {
        let image = ImageBuffer::from_fn(2, 1, |x, _| Rgb([x as u8, 7, 8]));
        let bytes = encoded(image, ImageFormat::Png);
        let turned = |turn| decode(&bytes, turn, &Limits::default()).expect("decodes");
        assert_eq!(turned(Orientation::Rotate180).samples(), [1, 7, 8, 0, 7, 8]);
        let upright = turned(Orientation::Rotate90);
        assert_eq!((upright.width(), upright.height(), upright.samples()), (1, 2, &[0, 7, 8, 1, 7, 8][..]));
    }

    fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.into().write_to(&mut bytes, format).expect("encodes");
        bytes.into_inner()
    }

    #[test]
    fn every_pixel_format_becomes_8_bit_color() {
        let limits = Limits::default();
        let deep = ImageBuffer::from_pixel(2, 1, Rgb([0x8000_u16, 0xffff, 0]));
        let gray = ImageBuffer::from_pixel(2, 1, Luma([77_u8]));
        let clear = ImageBuffer::from_pixel(2, 1, Rgba([1_u8, 2, 3, 4]));
        let opaque = ImageBuffer::from_pixel(2, 1, Rgba([1_u8, 2, 3, 255]));
        for (bytes, channels, samples) in [
            (encoded(deep, ImageFormat::Png), 3, [128_u8, 255, 0].repeat(2)),
            (encoded(gray.clone(), ImageFormat::Png), 3, vec![77; 6]),
            (encoded(gray, ImageFormat::WebP), 3, vec![77; 6]),
            (encoded(clear, ImageFormat::Png), 4, [1, 2, 3, 4].repeat(2)),
            (encoded(opaque, ImageFormat::Png), 3, [1, 2, 3].repeat(2)),
        ] {
            let header = header_of(&bytes).expect("a header");
            assert_eq!(header.size, (2, 1));
            assert!(header.alpha || channels == 3, "what has no alpha by its header gets none");
            let image = decode(&bytes, UPRIGHT, &limits).expect("decodes");
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
            assert!(decode(&bytes, UPRIGHT, &limits).is_ok());
            // The last bytes of a PNG are an empty chunk and those of a WebP padding: they hold no pixels.
            let needed = bytes.len() - if format == ImageFormat::Jpeg { 0 } else { 12 };
            for length in 0..needed {
                assert!(decode(&bytes[..length], UPRIGHT, &limits).is_err(), "{format:?} cut at {length}");
            }
        }
    }

    #[test]
    fn a_header_cannot_make_the_decoder_allocate_without_bound() {
        let small = Limits { image_pixels: 1, ..Limits::default() };
        // A valid PNG header that claims 60000 x 60000 pixels.
        let mut claims = encoded(ImageBuffer::from_pixel(1, 1, Rgb([0_u8; 3])), ImageFormat::Png);
        claims[16..24].copy_from_slice(&[0, 0, 0xea, 0x60, 0, 0, 0xea, 0x60]);
        assert!(decode(&claims, UPRIGHT, &small).is_err());
        assert!(decode(&claims, UPRIGHT, &Limits::default()).is_err());
    }

    #[test]
    fn the_size_of_an_extended_webp_is_in_its_first_bytes() {
        let mut head = b"RIFF\x00\x00\x10\x00WEBPVP8X\x0a\x00\x00\x00\x1c\x00\x00\x00".to_vec();
        head.extend([0x7f, 0x07, 0, 0x37, 0x04, 0]);
        let expected = Header { size: (1920, 1080), alpha: true, orientation: UPRIGHT };
        assert_eq!(header_of(&head).expect("a header"), expected);
        head[20] = 0x0c;
        assert!(!header_of(&head).expect("a header").alpha);
        head[26] = 0xff;
        assert!(header_of(&head).is_err(), "wider than any image");
    }

    proptest::proptest! {
        #[test]
        fn arbitrary_bytes_behind_any_signature_never_panic(
            signature in proptest::sample::select(vec![
                &b"\x89PNG\r\n\x1a\n\x00\x00\x00\x0dIHDR"[..],
                b"\xff\xd8\xff\xe0",
                b"RIFF\xff\xff\x00\x00WEBPVP8 ",
                b"RIFF\xff\xff\x00\x00WEBPVP8X",
                b"",
            ]),
            rest in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..200),
        ) {
            let bytes = [signature, &rest].concat();
            let small = Limits { image_pixels: 1 << 16, ..Limits::default() };
            let _outcomes = (header_of(&bytes).is_ok(), decode(&bytes, UPRIGHT, &small).is_ok());
        }
    }

    #[test]
    fn image_names_are_known_by_extension_in_any_case() {
        assert!(is_image_name("images/A.JPG") && is_image_name("a.webp") && is_image_name("a.b.jpeg"));
        assert!(!is_image_name("images/a") && !is_image_name("png") && !is_image_name("a.json"));
    }
}
