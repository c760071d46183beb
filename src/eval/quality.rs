//! PSNR and SSIM of two 8-bit RGB images, in f64.

use std::ops::Range;

use crate::domain::Image;

/// Reported for identical images, whose error has no logarithm.
const PSNR_CEILING: f64 = 100.0;

const WINDOW: usize = 11;
const REACH: usize = WINDOW / 2;
/// Rows that are compared at a time: each takes ten numbers a pixel.
const BAND: usize = 64;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// PSNR in dB with the squared error pooled over the three channels; `None` if the sizes differ or there is alpha.
#[must_use]
pub fn psnr(a: &Image, b: &Image) -> Option<f64> {
    comparable(a, b)?;
    let sum: f64 = a
        .samples()
        .iter()
        .zip(b.samples())
        .map(|(x, y)| {
            let difference = (f64::from(*x) - f64::from(*y)) / 255.0;
            difference * difference
        })
        .sum();
    let mse = sum / a.samples().len() as f64;
    Some(if mse > 0.0 { (-10.0 * mse.log10()).min(PSNR_CEILING) } else { PSNR_CEILING })
}

/// Mean SSIM over pixels and channels: Gaussian window of 11 taps and sigma 1.5 with zero padding (METHOD.md §1.2);
/// `None` if the sizes differ or there is alpha.
#[must_use]
pub fn ssim(a: &Image, b: &Image) -> Option<f64> {
    comparable(a, b)?;
    let (width, height) = (a.width() as usize, a.height() as usize);
    let mut total = 0.0;
    for channel in 0..3 {
        for top in (0..height).step_by(BAND) {
            let band = Band::new(top, width, height);
            let (x, y) = (band.plane(a, channel), band.plane(b, channel));
            let product =
                |p: &[f64], q: &[f64]| -> Vec<f64> { p.iter().zip(q).map(|(u, v)| u * v).collect() };
            let smooth = |p: &[f64]| band.blur(p);
            let (mx, my) = (smooth(&x), smooth(&y));
            let (xx, yy, xy) = (smooth(&product(&x, &x)), smooth(&product(&y, &y)), smooth(&product(&x, &y)));
            for i in 0..mx.len() {
                let (vx, vy, cov) = (xx[i] - mx[i] * mx[i], yy[i] - my[i] * my[i], xy[i] - mx[i] * my[i]);
                total += (2.0 * mx[i] * my[i] + C1) * (2.0 * cov + C2)
                    / ((mx[i] * mx[i] + my[i] * my[i] + C1) * (vx + vy + C2));
            }
        }
    }
    Some(total / (3 * width * height) as f64)
}

pub(super) fn comparable(a: &Image, b: &Image) -> Option<()> {
    let same = a.width() == b.width() && a.height() == b.height();
    (same && a.channels() == 3 && b.channels() == 3).then_some(())
}

fn window() -> [f64; WINDOW] {
    let mut taps: [f64; WINDOW] = std::array::from_fn(|i| {
        let offset = i as f64 - (WINDOW / 2) as f64;
        (-offset * offset / (2.0 * SIGMA * SIGMA)).exp()
    });
    let sum: f64 = taps.iter().sum();
    taps.iter_mut().for_each(|tap| *tap /= sum);
    taps
}

/// Some rows of an image, and those around them that the window of theirs reaches.
struct Band {
    rows: Range<usize>,
    seen: Range<usize>,
    width: usize,
    height: usize,
}

impl Band {
    /// The band that begins at row `top`.
    fn new(top: usize, width: usize, height: usize) -> Self {
        let rows = top..(top + BAND).min(height);
        let seen = rows.start.saturating_sub(REACH)..(rows.end + REACH).min(height);
        Self { rows, seen, width, height }
    }

    /// One channel of the rows that are seen, from 0 to 1.
    fn plane(&self, image: &Image, channel: usize) -> Vec<f64> {
        let samples = &image.samples()[3 * self.width * self.seen.start..3 * self.width * self.seen.end];
        samples.iter().skip(channel).step_by(3).map(|v| f64::from(*v) / 255.0).collect()
    }

    /// The band's rows of a plane of those that are seen, weighted by the window.
    fn blur(&self, plane: &[f64]) -> Vec<f64> {
        let (taps, width) = (window(), self.width);
        let mut across = vec![0.0; plane.len()];
        for (row, across) in plane.chunks_exact(width).zip(across.chunks_exact_mut(width)) {
            for (x, sum) in across.iter_mut().enumerate() {
                let (first, last) = (x.saturating_sub(REACH), (x + REACH).min(width - 1));
                *sum = (first..=last).map(|i| taps[i + REACH - x] * row[i]).sum();
            }
        }
        let mut blurred = Vec::with_capacity(width * self.rows.len());
        for y in self.rows.clone() {
            let (first, last) = (y.saturating_sub(REACH), (y + REACH).min(self.height - 1));
            for x in 0..width {
                let row = |i: usize| across[(i - self.seen.start) * width + x];
                blurred.push((first..=last).map(|i| taps[i + REACH - y] * row(i)).sum());
            }
        }
        blurred
    }
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
    fn ssim_of_tall_images_is_that_of_every_window() {
        let (width, height) = (9, 2 * BAND + 7);
        let a = image(9, height as u32, |i| (i * 37 % 251) as u8);
        let b = image(9, height as u32, |i| (i * 41 % 239) as u8);
        let (taps, mut total) = (window(), 0.0);
        for (channel, y, x) in (0..3 * height * width).map(|i| (i % 3, i / 3 / width, i / 3 % width)) {
            let mut moments = [0.0; 5];
            for (dy, dx) in (0..WINDOW * WINDOW).map(|i| (i / WINDOW, i % WINDOW)) {
                let (v, u) = ((y + dy).wrapping_sub(REACH), (x + dx).wrapping_sub(REACH));
                if v < height && u < width {
                    let at =
                        |image: &Image| f64::from(image.samples()[3 * (v * width + u) + channel]) / 255.0;
                    let (p, q, weight) = (at(&a), at(&b), taps[dy] * taps[dx]);
                    for (sum, value) in moments.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                        *sum += weight * value;
                    }
                }
            }
            let [p, q, pp, qq, pq] = moments;
            total += (2.0 * p * q + C1) * (2.0 * (pq - p * q) + C2)
                / ((p * p + q * q + C1) * (pp - p * p + qq - q * q + C2));
        }
        let expected = total / (3 * width * height) as f64;
        assert!((ssim(&a, &b).expect("comparable") - expected).abs() < 1e-12);
    }

    #[test]
    fn ssim_is_one_for_equal_images_and_less_for_noise() {
        let a = image(24, 17, |i| (i * 37 % 251) as u8);
        let b = image(24, 17, |i| (i * 37 % 251) as u8 ^ ((i * 7919 % 64) as u8));
        assert!((ssim(&a, &a).expect("comparable") - 1.0).abs() < 1e-12);
        let lower = ssim(&a, &b).expect("comparable");
        assert!(lower < 0.99 && lower > 0.0, "{lower}");
    }

    #[test]
    fn images_of_other_sizes_are_not_compared() {
        assert_eq!(psnr(&image(2, 2, |_| 0), &image(2, 3, |_| 0)), None);
        assert_eq!(ssim(&image(2, 2, |_| 0), &image(3, 2, |_| 0)), None);
    }
}
