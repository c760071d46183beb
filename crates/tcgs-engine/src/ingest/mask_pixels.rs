//! The pixels of masks: read, brought to the size of their photographs, and made smaller so that a pixel counts only if all that it
//! shows does.

use image::metadata::Orientation;

use super::{error::Result, images, limits::Limits};
use crate::domain::{Image, PixelMask};

/// The least value, of 255, that counts.
const WHITE: u8 = 128;

/// How far the filter that downscales photographs reaches, in pixels of the small image.
const FILTER_REACH: f64 = 2.0;

/// An 8-bit image of one channel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Plane {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) samples: Vec<u8>,
}

/// Which pixels of a mask are hidden.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Hidden {
    /// Those that are black, as in the masks of most programs.
    Black,
    /// Those that are white, as in instant-ngp's masks of moving things.
    White,
}

/// Whether a mask of one size fits a photograph of another: both have the same proportions up to the rounding of a side.
pub(super) fn fits(mask: (u32, u32), photograph: (u32, u32)) -> bool {
    let [mw, mh, pw, ph] = [mask.0, mask.1, photograph.0, photograph.1].map(f64::from);
    let smaller = |from: f64, to: f64| (from / to).max(to / from);
    // Within one pixel of the smaller image, and at most 16 times as large.
    let (x, y) = (mw / pw, mh / ph);
    let slack = 1.0 / mw.min(pw) + 1.0 / mh.min(ph);
    mask == photograph
        || ((x / y - 1.0).abs() <= slack.min(0.1) && smaller(mw, pw).max(smaller(mh, ph)) <= 16.0)
}

impl Plane {
    /// A mask from its file, turned: what is hidden is 0, and 255 is shown. Colors count by their brightest channel, weighted by alpha.
    ///
    /// # Errors
    /// [`super::IngestErrorKind::Image`] for a file that cannot be decoded.
    pub(super) fn decode(bytes: &[u8], turn: Orientation, hidden: Hidden, limits: &Limits) -> Result<Self> {
        let image = images::decode(bytes, turn, limits)?;
        let channels = usize::from(image.channels());
        let value = |pixel: &[u8]| {
            let brightest = u16::from(pixel[0].max(pixel[1]).max(pixel[2]));
            let alpha = pixel.get(3).map_or(255, |alpha| u16::from(*alpha));
            (brightest * alpha / 255) as u8
        };
        let mut samples: Vec<u8> = image.samples().chunks_exact(channels).map(value).collect();
        // Some programs write 1 for white.
        if samples.iter().all(|value| *value <= 1) {
            samples.iter_mut().for_each(|value| *value *= 255);
        }
        if hidden == Hidden::White {
            samples.iter_mut().for_each(|value| *value = 255 - *value);
        }
        Ok(Self { width: image.width(), height: image.height(), samples })
    }

    /// What is opaque of an image; `None` if all is.
    pub(super) fn opaque(image: &Image) -> Option<Self> {
        let (width, height) = (image.width(), image.height());
        let samples = |image: &Image| {
            image.samples().chunks_exact(4).map(|pixel| if pixel[3] == 255 { 255 } else { 0 }).collect()
        };
        (image.channels() == 4).then(|| Self { width, height, samples: samples(image) })
    }

    /// The share of pixels that are white.
    pub(super) fn white(&self) -> f64 {
        let white = self.samples.iter().filter(|value| **value >= WHITE).count();
        white as f64 / self.samples.len().max(1) as f64
    }

    /// Each sample to 0 or 255.
    pub(super) fn hard(mut self) -> Self {
        self.samples.iter_mut().for_each(|value| *value = if *value >= WHITE { 255 } else { 0 });
        self
    }

    /// As three equal channels.
    pub(super) fn to_image(&self) -> Option<Image> {
        let samples = self.samples.iter().flat_map(|value| [*value; 3]).collect();
        Image::new(self.width, self.height, 3, samples).ok()
    }

    /// The first channel of an image.
    pub(super) fn of_image(image: &Image) -> Self {
        let channels = usize::from(image.channels());
        let samples = image.samples().chunks_exact(channels).map(|pixel| pixel[0]).collect();
        Self { width: image.width(), height: image.height(), samples }
    }

    /// The least of two planes of one size; `self` if the sizes differ.
    pub(super) fn least(mut self, other: &Self) -> Self {
        if (self.width, self.height) == (other.width, other.height) {
            self.samples.iter_mut().zip(&other.samples).for_each(|(a, b)| *a = (*a).min(*b));
        }
        self
    }

    /// At another size: each pixel is the least of all that it covers.
    pub(super) fn resized(self, width: u32, height: u32) -> Self {
        if (self.width, self.height) == (width, height) { self } else { self.shrunk(width, height, 0.0) }
    }

    /// At the size of a photograph that was downscaled: each pixel is the least of all that the filter reads for it.
    pub(super) fn downscaled(self, width: u32, height: u32) -> Self {
        if (self.width, self.height) == (width, height) {
            self
        } else {
            self.shrunk(width, height, FILTER_REACH - 0.5)
        }
    }

    /// Each pixel is the least of those within itself and `margin` times its size around it; along rows, then along columns.
    fn shrunk(self, width: u32, height: u32, margin: f64) -> Self {
        let (from_width, from_height) = (self.width as usize, self.height as usize);
        let (across, down) = (spans(self.width, width, margin), spans(self.height, height, margin));
        let mut rows = Vec::with_capacity(width as usize * from_height);
        for row in self.samples.chunks_exact(from_width) {
            rows.extend(across.iter().map(|(first, last)| least(row[*first..*last].iter())));
        }
        let width_usize = width as usize;
        let mut samples = Vec::with_capacity(width_usize * down.len());
        for (first, last) in &down {
            debug_assert!(*last <= from_height);
            let columns = 0..width_usize;
            samples.extend(columns.map(|x| {
                least(rows[first * width_usize + x..last * width_usize].iter().step_by(width_usize))
            }));
        }
        Self { width, height, samples }
    }

    /// Which pixels count: those of full value.
    pub(super) fn mask(&self) -> Option<PixelMask> {
        PixelMask::from_samples(self.width, self.height, &self.samples)
    }
}

fn least<'a>(values: impl Iterator<Item = &'a u8>) -> u8 {
    values.copied().min().unwrap_or(0)
}

/// For each of `to` pixels, the first and the one behind the last of the `from` pixels that it covers, `margin` pixels more at each side.
fn spans(from: u32, to: u32, margin: f64) -> Vec<(usize, usize)> {
    let scale = f64::from(from) / f64::from(to);
    let span = |pixel: u32| {
        let (start, end) = (f64::from(pixel) - margin, f64::from(pixel) + 1.0 + margin);
        // Sides that are whole numbers of pixels up to rounding.
        let first = ((start * scale + 1e-9).floor().max(0.0) as usize).min(from as usize - 1);
        let last = ((end * scale - 1e-9).ceil() as usize).clamp(first + 1, from as usize);
        (first, last)
    };
    (0..to).map(span).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plane(width: u32, samples: &[u8]) -> Plane {
        Plane { width, height: samples.len() as u32 / width, samples: samples.to_vec() }
    }

    #[test]
    fn masks_fit_photographs_of_the_same_proportions() {
        for mask in [(4000, 3000), (1000, 750), (8000, 6000), (333, 250), (334, 251)] {
            assert!(fits(mask, (4000, 3000)), "{mask:?}");
        }
        for mask in [(3000, 4000), (4000, 2900), (100, 75), (3000, 3000), (1, 1)] {
            assert!(!fits(mask, (4000, 3000)), "{mask:?}");
        }
    }

    #[test]
    fn a_pixel_of_another_size_is_hidden_if_any_that_it_covers_is() {
        let small = plane(2, &[255, 0, 255, 255]).resized(4, 4);
        assert_eq!(small.samples, [255, 255, 0, 0, 255, 255, 0, 0, 255, 255, 255, 255, 255, 255, 255, 255]);
        let large = plane(4, &[255, 255, 255, 0, 255, 255, 255, 255]).resized(2, 1);
        assert_eq!(large.samples, [255, 0]);
        let uneven = plane(3, &[255, 0, 255]).resized(2, 1);
        assert_eq!(uneven.samples, [0, 0]);
    }

    #[test]
    fn a_downscaled_pixel_counts_only_if_all_that_the_filter_reads_does() {
        let mut samples = vec![255; 40];
        samples[20] = 0;
        let small = plane(40, &samples).downscaled(10, 1);
        // Pixel 20 of 40 is in pixel 5 of 10; the filter reaches two pixels from the center.
        assert_eq!(small.samples, [255, 255, 255, 0, 0, 0, 0, 255, 255, 255]);
    }

    #[test]
    fn values_of_zero_and_one_are_black_and_white() {
        let of = |values: &[u8], hidden| {
            let mut bytes = std::io::Cursor::new(Vec::new());
            let image =
                image::GrayImage::from_raw(values.len() as u32, 1, values.to_vec()).expect("an image");
            image.write_to(&mut bytes, image::ImageFormat::Png).expect("encodes");
            let decoded =
                Plane::decode(bytes.get_ref(), Orientation::NoTransforms, hidden, &Limits::default());
            decoded.expect("a mask").hard().samples
        };
        assert_eq!(of(&[0, 1, 1], Hidden::Black), [0, 255, 255]);
        assert_eq!(of(&[0, 100, 200], Hidden::Black), [0, 0, 255]);
        assert_eq!(of(&[0, 100, 200], Hidden::White), [255, 255, 0]);
        assert_eq!(of(&[0, 0, 0], Hidden::Black), [0, 0, 0]);
    }

    #[test]
    fn what_is_opaque_counts() {
        let image = Image::new(3, 1, 4, [[9, 9, 9, 255], [9, 9, 9, 254], [9, 9, 9, 0]].concat());
        let opaque = Plane::opaque(&image.expect("an image")).expect("it may be transparent");
        assert_eq!(opaque.samples, [255, 0, 0]);
        assert_eq!(opaque.mask().expect("a mask").counted(), 1);
    }
}
