//! PSNR of two 8-bit RGB images, in f64.

use std::array;

use crate::domain::Image;

/// Reported for identical images, whose error has no logarithm.
pub(super) const PSNR_CEILING: f64 = 100.0;

/// PSNR in dB with the squared error pooled over the three channels; `None` if the sizes differ or there is alpha.
#[must_use]
pub fn psnr(a: &Image, b: &Image) -> Option<f64> {
    psnr_counted(a, b, None)
}

/// As [`psnr`] over the pixels that count, whose number is `counted`, or all; the images are equal at the others.
pub(super) fn psnr_counted(a: &Image, b: &Image, counted: Option<u64>) -> Option<f64> {
    comparable(a, b)?;
    // The square of each difference of two levels.
    let squares: [f64; 256] = array::from_fn(|difference| {
        let difference = difference as f64 / 255.0;
        difference * difference
    });
    let pairs = a.samples().iter().zip(b.samples());
    let sum: f64 = pairs.map(|(x, y)| squares[usize::from(x.abs_diff(*y))]).sum();
    let samples = counted.map_or(a.samples().len() as u64, |counted| 3 * counted.max(1));
    let mse = sum / samples as f64;
    Some(if mse > 0.0 { (-10.0 * mse.log10()).min(PSNR_CEILING) } else { PSNR_CEILING })
}

pub(super) fn comparable(a: &Image, b: &Image) -> Option<()> {
    let same = a.width() == b.width() && a.height() == b.height();
    (same && a.channels() == 3 && b.channels() == 3).then_some(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: u32, height: u32, value: impl Fn(usize) -> u8) -> Image {
        let samples = (0..(width * height * 3) as usize).map(value).collect();
        Image::new(width, height, 3, samples).expect("an image")
    }

    #[test]
    fn psnr_of_a_constant_difference_is_its_logarithm() {
        let (a, b) = (image(7, 5, |_| 100), image(7, 5, |_| 151));
        assert!((psnr(&a, &b).expect("comparable") - 13.979_400_086_720_375).abs() < 1e-9);
        assert_eq!(psnr(&a, &a), Some(PSNR_CEILING));
    }

    #[test]
    fn psnr_has_the_bits_of_the_squared_differences_added_one_after_the_other() {
        let (a, b) = (image(61, 47, |i| (i * 37 % 251) as u8), image(61, 47, |i| (i * 83 % 256) as u8));
        let square = |(x, y): (&u8, &u8)| ((f64::from(*x) - f64::from(*y)) / 255.0).powi(2);
        let sum: f64 = a.samples().iter().zip(b.samples()).map(square).sum();
        let wanted = -10.0 * (sum / a.samples().len() as f64).log10();
        assert_eq!(psnr(&a, &b).expect("comparable").to_bits(), wanted.to_bits());
    }

    #[test]
    fn images_of_other_sizes_are_not_compared() {
        assert_eq!(psnr(&image(2, 2, |_| 0), &image(2, 3, |_| 0)), None);
    }
}
