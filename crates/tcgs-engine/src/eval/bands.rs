//! The difference of two 8-bit images in the low and the high bands of the two-level Haar transform, which separates the error of
//! broad shapes from that of edges and texture.

use glam::{DVec3, USizeVec2};
use serde::{Deserialize, Serialize};

use super::{Haar, quality::comparable};
use crate::domain::Image;

/// Mean absolute differences of orthonormal Haar coefficients of samples in [0, 1].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BandErrors {
    /// Of the second level's low band, in [0, 4]: four times the differences of the means of 4 x 4 pixels.
    pub low: f64,
    /// The mean over the three high bands of both levels.
    pub high: f64,
}

/// The errors of `a` against `b`; `None` if the sizes differ or there is alpha.
#[must_use]
pub fn band_errors(a: &Image, b: &Image) -> Option<BandErrors> {
    comparable(a, b)?;
    let size = USizeVec2::new(a.width() as usize, a.height() as usize);
    let pixels = a.samples().chunks_exact(3).zip(b.samples().chunks_exact(3));
    // The transform is linear: the difference's bands are the bands' differences.
    let difference: Vec<DVec3> = pixels.map(|(a, b)| (color(a) - color(b)) / 255.0).collect();
    let fine = Haar::of(size, &difference);
    let coarse = Haar::of(fine.size, &fine.low);
    let high = fine.high.iter().chain(&coarse.high).map(|band| mean_size(band)).sum::<f64>() / 6.0;
    Some(BandErrors { low: mean_size(&coarse.low), high })
}

fn color(pixel: &[u8]) -> DVec3 {
    DVec3::new(f64::from(pixel[0]), f64::from(pixel[1]), f64::from(pixel[2]))
}

fn mean_size(band: &[DVec3]) -> f64 {
    band.iter().map(|v| v.abs().element_sum()).sum::<f64>() / (3 * band.len()) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: u32, height: u32, value: impl Fn(u32, u32) -> u8) -> Image {
        let places = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let samples = places.flat_map(|(x, y)| [value(x, y); 3]).collect();
        Image::new(width, height, 3, samples).expect("an image")
    }

    fn errors(a: &Image, b: &Image) -> BandErrors {
        band_errors(a, b).expect("comparable")
    }

    #[test]
    fn equal_images_have_no_error_in_any_band() {
        let a = image(9, 6, |x, y| (x * 29 + y * 3) as u8);
        assert_eq!(errors(&a, &a), BandErrors { low: 0.0, high: 0.0 });
    }

    #[test]
    fn a_change_of_brightness_is_all_low_and_a_fine_pattern_all_high() {
        let plain = image(8, 8, |_, _| 100);
        let brighter = errors(&plain, &image(8, 8, |_, _| 151));
        assert!((brighter.low - 4.0 * 0.2).abs() < 1e-12 && brighter.high == 0.0, "{brighter:?}");
        let checked = errors(&plain, &image(8, 8, |x, y| if (x + y) % 2 == 0 { 151 } else { 49 }));
        // One of six bands, the finest HH, differs: by 4 * 0.2 / 2 everywhere.
        assert!(checked.low == 0.0 && (checked.high - 0.4 / 6.0).abs() < 1e-12, "{checked:?}");
    }

    #[test]
    fn one_pixel_alone_in_a_padded_image_is_in_every_band() {
        let found = errors(&image(1, 1, |_, _| 255), &image(1, 1, |_, _| 0));
        // A half after one level, a quarter after two.
        assert_eq!(found, BandErrors { low: 0.25, high: (0.5 + 0.25) / 2.0 });
    }

    #[test]
    fn images_of_other_shapes_are_not_compared() {
        assert_eq!(band_errors(&image(2, 2, |_, _| 0), &image(2, 3, |_, _| 0)), None);
        let with_alpha = Image::new(2, 2, 4, vec![0; 16]).expect("an image");
        assert_eq!(band_errors(&image(2, 2, |_, _| 0), &with_alpha), None);
    }
}
