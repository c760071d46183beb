//! Rendered views as files.

use bytes::Bytes;

use crate::{
    domain::{Image, named_choice},
    picture::{PictureError, PictureFormat, deep_gray_png, gray_png},
    render::views::ScalarImage,
};

/// Default quality of JPEG.
const JPEG_QUALITY: u8 = 90;

named_choice! {
    /// A file format for views. All but JPEG are lossless, and so is WebP without a quality.
    pub(crate) enum Format {
        Png = "png",
        Jpeg = "jpeg",
        Webp = "webp",
        /// A NumPy array, for outputs with one number per pixel.
        Npy = "npy",
    }
}

impl Format {
    fn media_type(self) -> &'static str {
        match self {
            Format::Png => "image/png",
            Format::Jpeg => "image/jpeg",
            Format::Webp => "image/webp",
            Format::Npy => "application/x-npy",
        }
    }

    fn extension(self) -> &'static str {
        match self {
            Format::Png => "png",
            Format::Jpeg => "jpg",
            Format::Webp => "webp",
            Format::Npy => "npy",
        }
    }
}

named_choice! {
    /// What a picture shows.
    #[derive(Default)]
    pub(crate) enum Output {
        #[default]
        Color = "color",
        Depth = "depth",
        Alpha = "alpha",
    }
}

named_choice! {
    /// A file format for animations. Both are lossless, WebP without a quality alone.
    #[derive(Default)]
    pub(crate) enum AnimationFormat {
        #[default]
        Apng = "apng",
        Webp = "webp",
    }
}

impl AnimationFormat {
    /// The kind of its frames.
    pub(crate) fn of_frames(self, quality: Option<u8>) -> Result<PictureKind, SettingError> {
        let format = match self {
            Self::Apng => Format::Png,
            Self::Webp => Format::Webp,
        };
        PictureKind::new(Some(Output::Color), Some(format), quality, format)
    }
}

/// A quality that encoders take.
fn checked_quality(quality: u8) -> Result<u8, SettingError> {
    match quality {
        1..=100 => Ok(quality),
        _ => Err(("quality", format!("{quality} is outside 1..=100"))),
    }
}

/// An invalid setting: its name, and what is wrong.
pub(crate) type SettingError = (&'static str, String);

/// Output and format of a picture; only valid combinations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct PictureKind {
    pub(crate) output: Output,
    pub(crate) format: Format,
    /// Of JPEG and of lossy WebP; 0 for what loses nothing.
    pub(crate) quality: u8,
}

impl PictureKind {
    /// The requested kind; color is written as `default` if no format is given.
    pub(crate) fn new(
        output: Option<Output>,
        format: Option<Format>,
        quality: Option<u8>,
        default: Format,
    ) -> Result<Self, SettingError> {
        let output = output.unwrap_or_default();
        let (default, possible): (_, &[Format]) = match output {
            Output::Color => (default, &[Format::Png, Format::Jpeg, Format::Webp]),
            Output::Depth | Output::Alpha => (Format::Png, &[Format::Png, Format::Npy]),
        };
        let format = format.unwrap_or(default);
        if !possible.contains(&format) {
            let error = match output {
                Output::Color => "npy is for output=depth and output=alpha".to_owned(),
                _ => format!("{} is written as png or npy only", output.name()),
            };
            return Err(("format", error));
        }
        let quality = match (format, quality) {
            (Format::Jpeg, None) => JPEG_QUALITY,
            (Format::Jpeg | Format::Webp, Some(quality)) => checked_quality(quality)?,
            (_, Some(_)) => {
                return Err(("quality", "only jpeg and webp have a quality; the others lose nothing".into()));
            }
            (_, None) => 0,
        };
        Ok(Self { output, format, quality })
    }

    /// The name, version and settings of what encodes it.
    pub(crate) fn encoder(self) -> &'static str {
        self.file_format().map_or("NumPy's array format, version 1.0", PictureFormat::encoder)
    }

    /// `None` for arrays.
    fn file_format(self) -> Option<PictureFormat> {
        match self.format {
            Format::Png => Some(PictureFormat::Png),
            Format::Jpeg => Some(PictureFormat::Jpeg { quality: self.quality }),
            Format::Webp if self.quality > 0 => Some(PictureFormat::LossyWebp { quality: self.quality }),
            Format::Webp => Some(PictureFormat::Webp),
            Format::Npy => None,
        }
    }
}

/// A rendered view.
#[derive(Debug)]
pub(crate) enum Rendered {
    Color(Image),
    Depth(ScalarImage),
    Alpha(ScalarImage),
}

/// An encoded view.
#[derive(Debug, Clone)]
pub(crate) struct Picture {
    pub(crate) bytes: Bytes,
    format: Format,
    depth_scale: Option<f64>,
}

impl Picture {
    /// Encodes a rendered view.
    pub(crate) fn encode(rendered: &Rendered, kind: PictureKind) -> Result<Self, PictureError> {
        let format = kind.format;
        let (bytes, depth_scale) = match (rendered, format) {
            (Rendered::Color(image), _) => {
                (kind.file_format().unwrap_or(PictureFormat::Png).encode(image)?, None)
            }
            (Rendered::Depth(plane) | Rendered::Alpha(plane), Format::Npy) => (npy(plane), None),
            (Rendered::Depth(plane), _) => {
                let (bytes, scale) = depth_png(plane)?;
                (bytes, Some(scale))
            }
            (Rendered::Alpha(plane), _) => (alpha_png(plane)?, None),
        };
        Ok(Self { bytes: bytes.into(), format, depth_scale })
    }

    pub(crate) fn media_type(&self) -> &'static str {
        self.format.media_type()
    }

    pub(crate) fn extension(&self) -> &'static str {
        self.format.extension()
    }

    /// World units per step of a 16-bit depth.
    pub(crate) fn depth_scale(&self) -> Option<f64> {
        self.depth_scale
    }
}

/// 16-bit gray and its world units per step: the deepest pixel is 65535, an empty one 0.
fn depth_png(plane: &ScalarImage) -> Result<(Vec<u8>, f64), PictureError> {
    let deepest = plane.values.iter().copied().fold(0.0_f32, f32::max);
    let scale = if deepest > 0.0 { f64::from(deepest) / f64::from(u16::MAX) } else { 1.0 };
    let step = |depth: f32| {
        // A covered pixel must not become an empty one.
        let min = if depth > 0.0 { 1.0 } else { 0.0 };
        (f64::from(depth) / scale).round().clamp(min, f64::from(u16::MAX)) as u16
    };
    let samples: Vec<u16> = plane.values.iter().map(|depth| step(*depth)).collect();
    Ok((deep_gray_png(&samples, plane.width, plane.height)?, scale))
}

fn alpha_png(plane: &ScalarImage) -> Result<Vec<u8>, PictureError> {
    let samples: Vec<u8> =
        plane.values.iter().map(|alpha| (alpha.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    gray_png(&samples, plane.width, plane.height)
}

/// Version 1.0 of NumPy's array format: `[height, width]` of little-endian float32.
fn npy(plane: &ScalarImage) -> Vec<u8> {
    let mut head =
        format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}, {}), }}", plane.height, plane.width);
    const PREFIX: usize = 10;
    while !(PREFIX + head.len() + 1).is_multiple_of(64) {
        head.push(' ');
    }
    head.push('\n');
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend_from_slice(&(head.len() as u16).to_le_bytes());
    file.extend_from_slice(head.as_bytes());
    file.extend(plane.values.iter().flat_map(|value| value.to_le_bytes()));
    file
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;

    fn kind(output: Output, format: Format) -> PictureKind {
        PictureKind::new(Some(output), Some(format), None, Format::Png).expect("they go together")
    }

    fn plane() -> ScalarImage {
        ScalarImage { width: 3, height: 2, values: vec![0.0, 1e-6, 0.5, 1.0, 2.0, 4.0] }
    }

    fn read(picture: &Picture) -> image::DynamicImage {
        let reader = image::ImageReader::new(Cursor::new(&picture.bytes)).with_guessed_format();
        reader.expect("in memory").decode().expect("decodes")
    }

    #[test]
    fn every_format_of_color_reads_back_and_the_lossless_ones_exactly() {
        for channels in [3, 4] {
            let samples: Vec<u8> = (0..5 * 3 * channels).map(|i| (i * 7 % 256) as u8).collect();
            let image = Image::new(5, 3, channels as u8, samples.clone()).expect("an image");
            let image = Rendered::Color(image);
            for format in [Format::Png, Format::Jpeg, Format::Webp] {
                let file = Picture::encode(&image, kind(Output::Color, format)).expect("encodes");
                let guessed = image::guess_format(&file.bytes).expect("a known format");
                assert_eq!(file.media_type(), guessed.to_mime_type());
                let back = read(&file);
                assert_eq!((back.width(), back.height()), (5, 3));
                if format != Format::Jpeg {
                    assert_eq!(back.as_bytes(), samples, "{format:?} with {channels} channels");
                }
            }
        }
    }

    #[test]
    fn depth_is_sixteen_bits_with_a_scale_and_nothing_is_zero() {
        let file = Picture::encode(&Rendered::Depth(plane()), kind(Output::Depth, Format::Png));
        let file = file.expect("encodes");
        let scale = file.depth_scale().expect("a scale");
        let image::DynamicImage::ImageLuma16(back) = read(&file) else { panic!("not 16-bit gray") };
        assert_eq!((back.as_raw()[0], back.as_raw()[1], back.as_raw()[5]), (0, 1, 65535));
        for (step, depth) in back.as_raw().iter().zip(plane().values).skip(2) {
            assert!((f64::from(*step) * scale - f64::from(depth)).abs() <= 0.5 * scale, "{step} {depth}");
        }
        let empty = ScalarImage { values: vec![0.0; 6], ..plane() };
        let file = Picture::encode(&Rendered::Depth(empty), kind(Output::Depth, Format::Png));
        assert_eq!(read(&file.expect("encodes")).as_bytes(), [0; 12]);
    }

    #[test]
    fn alpha_is_eight_bits_and_arrays_hold_the_floats_themselves() {
        let alpha = ScalarImage { width: 3, height: 1, values: vec![0.0, 0.5, 1.0] };
        let file = Picture::encode(&Rendered::Alpha(alpha), kind(Output::Alpha, Format::Png));
        assert_eq!(read(&file.expect("encodes")).as_bytes(), [0, 128, 255]);
        let file = Picture::encode(&Rendered::Depth(plane()), kind(Output::Depth, Format::Npy));
        let file = file.expect("encodes");
        assert_eq!(file.depth_scale(), None, "floats are world units");
        let (head, values) = file.bytes.split_at(file.bytes.len() - 24);
        assert_eq!(head.len() % 64, 0);
        assert_eq!(&head[..10], b"\x93NUMPY\x01\x00\x76\x00");
        let text = std::str::from_utf8(&head[10..]).expect("ASCII");
        assert!(text.starts_with("{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }"), "{text}");
        let values: Vec<f32> =
            values.chunks(4).map(|b| f32::from_le_bytes(b.try_into().expect("four"))).collect();
        assert_eq!(values, plane().values);
    }

    #[test]
    fn settings_that_do_not_go_together_are_refused_by_name() {
        use Format::{Jpeg, Npy, Png, Webp};
        use Output::{Alpha, Color, Depth};
        let new = |output, format, quality| PictureKind::new(Some(output), format, quality, Png);
        for (output, format, quality, named) in [
            (Color, Some(Npy), None, "format"),
            (Depth, Some(Jpeg), None, "format"),
            (Alpha, Some(Webp), None, "format"),
            (Color, Some(Png), Some(50), "quality"),
            (Color, None, Some(50), "quality"),
            (Color, Some(Jpeg), Some(0), "quality"),
            (Color, Some(Jpeg), Some(101), "quality"),
            (Color, Some(Webp), Some(0), "quality"),
        ] {
            assert_eq!(new(output, format, quality).expect_err("a fault").0, named);
        }
        assert_eq!(new(Color, Some(Jpeg), None).expect("fits").quality, 90);
        let default = PictureKind::new(None, None, Some(40), Jpeg).expect("fits");
        assert_eq!(default, PictureKind { output: Color, format: Jpeg, quality: 40 });
        assert_eq!(PictureKind::new(Some(Depth), None, None, Jpeg).expect("fits").format, Png);
    }
}
