//! Baseline JPEG in strips that are encoded in parallel and joined by restart markers.
//!
//! A restart marker ends a strip's bits at a whole byte and resets the prediction of mean values, so strips are
//! independent (ITU-T T.81, E.1.4). Every baseline decoder reads them; they take some 30 bytes a strip. The strips' height is
//! fixed, so the bytes do not depend on the number of threads.

use std::borrow::Cow;

use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use rayon::prelude::*;

use super::PictureError;
use crate::domain::Image;

/// Side of a block. Without subsampling, three of them are coded together.
const BLOCK: usize = 8;
/// Rows of a strip. Its blocks are fewer than the 65535 of a restart interval at the largest width, 16384.
const STRIP: usize = 64;

const END: [u8; 2] = [0xff, 0xd9];
const FRAME: u8 = 0xc0;
const SCAN: u8 = 0xda;
/// The first of eight.
const RESTART: u8 = 0xd0;

/// The file of an image at a quality from 1 to 100.
pub(super) fn encode(image: &Image, quality: u8) -> Result<Vec<u8>, PictureError> {
    let image = if image.channels() == 3 { Cow::Borrowed(image) } else { Cow::Owned(image.over([0; 3])) };
    let width = image.width() as usize;
    let rows: Vec<&[u8]> = image.samples().chunks(3 * width * STRIP).collect();
    let strips = rows.into_par_iter().map(|samples| strip(samples, width, quality));
    let strips: Vec<Vec<u8>> = strips.collect::<Result<_, _>>()?;
    join(&strips, image.height())
}

/// A file of one strip, for a restart interval of a whole one.
fn strip(samples: &[u8], width: usize, quality: u8) -> Result<Vec<u8>, PictureError> {
    let height = samples.len() / (3 * width);
    let mut file = Vec::with_capacity(samples.len() / 8 + 1024);
    let mut encoder = Encoder::new(&mut file, quality);
    encoder.set_sampling_factor(SamplingFactor::F_1_1);
    encoder.set_restart_interval((width.div_ceil(BLOCK) * (STRIP / BLOCK)) as u16);
    encoder.encode(samples, width as u16, height as u16, ColorType::Rgb)?;
    Ok(file)
}

/// One file of the strips of an image of this height.
fn join(strips: &[Vec<u8>], height: u32) -> Result<Vec<u8>, PictureError> {
    let mut file = Vec::with_capacity(strips.iter().map(Vec::len).sum());
    for (index, strip) in strips.iter().enumerate() {
        let head = Head::of(strip)?;
        let (head_bytes, bits) = strip.split_at(head.length);
        let bits = bits.strip_suffix(&END).ok_or(PictureError::Incomplete("an end"))?;
        if index == 0 {
            file.extend_from_slice(head_bytes);
            file[head.height_at..][..2].copy_from_slice(&(height as u16).to_be_bytes());
        } else {
            file.extend([0xff, RESTART + ((index - 1) % 8) as u8]);
        }
        file.extend_from_slice(bits);
    }
    file.extend(END);
    Ok(file)
}

/// Places in a file before its coded bits.
struct Head {
    /// Where the height of the frame is.
    height_at: usize,
    length: usize,
}

impl Head {
    fn of(file: &[u8]) -> Result<Self, PictureError> {
        let mut height_at = None;
        // Behind the marker of the start, which has no length.
        let mut at = 2;
        while let Some([0xff, marker, high, low]) = file.get(at..).and_then(|rest| rest.first_chunk()) {
            if *marker == FRAME {
                // Marker, length, bits a sample.
                height_at = Some(at + 5);
            }
            let end = at + 2 + usize::from(u16::from_be_bytes([*high, *low]));
            if *marker == SCAN {
                let height_at = height_at.ok_or(PictureError::Incomplete("a frame's head"))?;
                return Ok(Self { height_at, length: end.min(file.len()) });
            }
            at = end;
        }
        Err(PictureError::Incomplete("a scan"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gradient(width: u32, height: u32, channels: u8) -> Image {
        let value = |i: usize| (i / 7 + (i * 37 % 19)) as u8;
        let samples = (0..(width * height) as usize * usize::from(channels)).map(value).collect();
        Image::new(width, height, channels, samples).expect("an image")
    }

    fn decoded(file: &[u8]) -> image::RgbImage {
        let file = std::io::Cursor::new(file);
        image::ImageReader::with_format(file, image::ImageFormat::Jpeg).decode().expect("decodes").to_rgb8()
    }

    #[test]
    fn strips_decode_to_the_pixels_of_one_scan() {
        for (width, height) in [(1, 1), (8, 64), (9, 65), (33, 200), (20, 11 * STRIP as u32 + 3)] {
            let image = gradient(width, height, 3);
            let file = encode(&image, 85).expect("encodes");
            let mut whole = Vec::new();
            let mut encoder = Encoder::new(&mut whole, 85);
            encoder.set_sampling_factor(SamplingFactor::F_1_1);
            encoder.encode(image.samples(), width as u16, height as u16, ColorType::Rgb).expect("encodes");
            let found = decoded(&file);
            assert_eq!(found.dimensions(), (width, height));
            assert!(found == decoded(&whole), "{width}x{height}");
        }
    }

    #[test]
    fn the_bytes_do_not_depend_on_the_number_of_threads() {
        let image = gradient(40, 5 * STRIP as u32, 3);
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| encode(&image, 90)).expect("encodes")
        };
        assert_eq!(with(1), with(3));
    }

    #[test]
    fn the_largest_strip_fits_a_restart_interval() {
        let blocks = crate::domain::camera::MAX_IMAGE_SIDE as usize / BLOCK * (STRIP / BLOCK);
        assert!(u16::try_from(blocks).is_ok(), "{blocks}");
    }

    #[test]
    fn transparent_pixels_are_over_black() {
        let clear = Image::new(16, 16, 4, [255, 255, 255, 0].repeat(256)).expect("an image");
        let file = encode(&clear, 90).expect("encodes");
        assert!(decoded(&file).pixels().all(|pixel| pixel.0.iter().all(|value| *value <= 1)));
    }

    #[test]
    fn a_file_without_its_parts_is_an_error() {
        let file = encode(&gradient(8, 8, 3), 90).expect("encodes");
        let length = Head::of(&file).expect("a head").length;
        for end in 0..length - 1 {
            let cut = &file[..end];
            if let Ok(head) = Head::of(cut) {
                assert!(head.length <= cut.len());
            }
        }
        assert!(join(&[file[..length].to_vec()], 8).is_err());
    }
}
