//! A photograph as renders are compared with it: over the background, and only where its pixels count.
//!
//! A pixel that does not count is black in both images, as it is outside of them: no figure depends on what a mask hides. Means are over
//! the pixels that count; SSIM's windows are those around them (METHOD.md §1.2), as in training.

use std::borrow::Cow;

use super::{BandErrors, band_errors, quality::psnr_counted, ssim::ssim_where};
use crate::domain::{Background, Frame, Image, PhotographError, PixelMask, ViewScore};

/// A photograph to compare renders with.
#[derive(Debug, Clone)]
pub struct Target {
    photograph: Image,
    mask: Option<PixelMask>,
}

impl Target {
    /// The photograph of a frame.
    ///
    /// # Errors
    /// A photograph that cannot be read back.
    pub fn of(frame: &Frame, background: Background) -> Result<Self, PhotographError> {
        Ok(Self::new(frame.image.load()?.over(background.rgb8()), frame.mask.clone()))
    }

    /// A photograph of which the pixels of `mask` count, or all.
    #[must_use]
    pub fn new(photograph: Image, mask: Option<PixelMask>) -> Self {
        let photograph = match &mask {
            Some(mask) => blanked(&photograph, mask).unwrap_or(photograph),
            None => photograph,
        };
        Self { photograph, mask }
    }

    /// The photograph, black where no pixel counts.
    #[must_use]
    pub fn photograph(&self) -> &Image {
        &self.photograph
    }

    /// Which pixels count; all without one.
    pub(super) fn mask(&self) -> Option<&PixelMask> {
        self.mask.as_ref()
    }

    /// Errors by band of a render, over the pixels that count; `None` if it is not of the photograph's shape or no pixel counts.
    #[must_use]
    pub fn band_errors(&self, render: &Image) -> Option<BandErrors> {
        let errors = band_errors(&self.masked(render), &self.photograph)?;
        let Some(mask) = &self.mask else { return Some(errors) };
        // Elsewhere both are black, so that sums of differences are those of the pixels that count.
        let pixels = u64::from(mask.width()) * u64::from(mask.height());
        let share = mask.counted() as f64 / pixels as f64;
        (share > 0.0).then(|| BandErrors { low: errors.low / share, high: errors.high / share })
    }

    /// A render, black where no pixel counts.
    #[must_use]
    pub fn masked<'a>(&self, render: &'a Image) -> Cow<'a, Image> {
        let blank = self.mask.as_ref().and_then(|mask| blanked(render, mask));
        blank.map_or(Cow::Borrowed(render), Cow::Owned)
    }

    /// PSNR of a render in dB; `None` if it is not of the photograph's shape.
    #[must_use]
    pub fn psnr(&self, render: &Image) -> Option<f64> {
        psnr_counted(&self.masked(render), &self.photograph, self.mask.as_ref().map(PixelMask::counted))
    }

    /// SSIM of a render; `None` if it is not of the photograph's shape.
    #[must_use]
    pub fn ssim(&self, render: &Image) -> Option<f64> {
        ssim_where(&self.masked(render), &self.photograph, self.mask.as_ref())
    }

    /// PSNR and SSIM of a render; `None` if it is not of the photograph's shape.
    #[must_use]
    pub fn score(&self, name: &str, render: &Image) -> Option<ViewScore> {
        let (render, mask) = (self.masked(render), self.mask.as_ref());
        let (psnr, ssim) = rayon::join(
            || psnr_counted(&render, &self.photograph, mask.map(PixelMask::counted)),
            || ssim_where(&render, &self.photograph, mask),
        );
        Some(ViewScore { name: name.to_owned(), psnr: psnr?, ssim: ssim?, lpips: None })
    }
}

/// An RGB image with black where no pixel counts; `None` if it is not of the mask's shape.
fn blanked(image: &Image, mask: &PixelMask) -> Option<Image> {
    if (image.width(), image.height(), image.channels()) != (mask.width(), mask.height(), 3) {
        return None;
    }
    let mut samples = image.samples().to_vec();
    let pixels = samples.chunks_exact_mut(3).zip(mask.iter());
    pixels.filter(|(_, counts)| !counts).for_each(|(pixel, _)| pixel.fill(0));
    Image::new(image.width(), image.height(), 3, samples).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::{psnr, score_view, ssim};

    fn image(width: u32, height: u32, seed: u32) -> Image {
        let value = |i: u32| (i.wrapping_mul(seed).wrapping_mul(2_654_435_761) >> 24) as u8;
        Image::new(width, height, 3, (0..width * height * 3).map(value).collect()).expect("an image")
    }

    #[test]
    fn a_mask_under_which_all_counts_changes_no_bit() {
        let (a, b) = (image(40, 23, 3), image(40, 23, 7));
        let all = Target::new(b.clone(), Some(PixelMask::from_fn(40, 23, |_, _| true)));
        assert_eq!(all.score("a", &a), score_view("a", &a, &b));
        assert_eq!(Target::new(b.clone(), None).score("a", &a), score_view("a", &a, &b));
    }

    #[test]
    fn errors_by_band_are_means_over_what_counts() {
        // The left half, whose blocks of 4 x 4 pixels lie within it.
        let left = PixelMask::from_fn(32, 16, |x, _| x < 16);
        let gray = |value: u8| Image::new(32, 16, 3, vec![value; 32 * 16 * 3]).expect("an image");
        let all = Target::new(gray(100), None).band_errors(&gray(151)).expect("comparable");
        let half = Target::new(gray(100), Some(left)).band_errors(&gray(151)).expect("comparable");
        assert!((half.low - all.low).abs() < 1e-12 && half.high == 0.0, "{half:?} {all:?}");
        let none = PixelMask::from_fn(32, 16, |_, _| false);
        assert_eq!(Target::new(gray(100), Some(none)).band_errors(&gray(151)), None);
    }

    #[test]
    fn no_figure_depends_on_what_is_ignored() {
        let mask = PixelMask::from_fn(40, 23, |x, y| x < 25 || y > 15);
        let (a, b) = (image(40, 23, 3), image(40, 23, 7));
        let painted = |image: &Image, red: u8| {
            let pixels = image.samples().chunks_exact(3).zip(mask.iter());
            let samples =
                pixels.flat_map(|(p, counts)| if counts { [p[0], p[1], p[2]] } else { [red, 0, 9] });
            Image::new(40, 23, 3, samples.collect()).expect("an image")
        };
        let score = |a: &Image, b: &Image| Target::new(b.clone(), Some(mask.clone())).score("a", a);
        let expected = score(&a, &b).expect("comparable");
        assert_eq!(score(&painted(&a, 255), &painted(&b, 3)).as_ref(), Some(&expected));
        assert_ne!(score_view("a", &painted(&a, 255), &b), Some(expected));
    }

    #[test]
    fn what_is_outside_of_a_mask_is_as_outside_of_the_image() {
        // The mask keeps the left part: the figures are those of the left parts alone.
        let (a, b) = (image(40, 23, 3), image(40, 23, 7));
        let left = |image: &Image| {
            let rows = image.samples().chunks_exact(120).flat_map(|row| row[..63].to_vec());
            Image::new(21, 23, 3, rows.collect()).expect("an image")
        };
        let target = Target::new(b.clone(), Some(PixelMask::from_fn(40, 23, |x, _| x < 21)));
        let (whole, part) = (target.psnr(&a).expect("comparable"), psnr(&left(&a), &left(&b)));
        assert!((whole - part.expect("comparable")).abs() < 1e-9);
        let (whole, part) = (target.ssim(&a).expect("comparable"), ssim(&left(&a), &left(&b)));
        assert!((whole - part.expect("comparable")).abs() < 1e-12);
    }

    #[test]
    fn where_nothing_counts_nothing_is_wrong() {
        let target = Target::new(image(4, 4, 3), Some(PixelMask::from_fn(4, 4, |_, _| false)));
        let score = target.score("a", &image(4, 4, 7)).expect("comparable");
        assert_eq!((score.psnr, score.ssim), (100.0, 1.0));
        assert_eq!(target.score("a", &image(4, 5, 7)), None);
    }
}
