//! PSNR and SSIM of two 8-bit RGB images, in f64.

use crate::domain::Image;

/// Reported for identical images, whose error has no logarithm.
const PSNR_CEILING: f64 = 100.0;

const WINDOW: usize = 11;
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
        let plane = |image: &Image| -> Vec<f64> {
            image.samples().iter().skip(channel).step_by(3).map(|v| f64::from(*v) / 255.0).collect()
        };
        let (x, y) = (plane(a), plane(b));
        let product = |p: &[f64], q: &[f64]| -> Vec<f64> { p.iter().zip(q).map(|(u, v)| u * v).collect() };
        let smooth = |p: &[f64]| blur(p, width, height);
        let (mx, my) = (smooth(&x), smooth(&y));
        let (xx, yy, xy) = (smooth(&product(&x, &x)), smooth(&product(&y, &y)), smooth(&product(&x, &y)));
        for i in 0..width * height {
            let (vx, vy, cov) = (xx[i] - mx[i] * mx[i], yy[i] - my[i] * my[i], xy[i] - mx[i] * my[i]);
            total += (2.0 * mx[i] * my[i] + C1) * (2.0 * cov + C2)
                / ((mx[i] * mx[i] + my[i] * my[i] + C1) * (vx + vy + C2));
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

fn blur(plane: &[f64], width: usize, height: usize) -> Vec<f64> {
    let taps = window();
    let reach = WINDOW / 2;
    let mut rows = vec![0.0; plane.len()];
    for y in 0..height {
        for x in 0..width {
            let (first, last) = (x.saturating_sub(reach), (x + reach).min(width - 1));
            rows[y * width + x] = (first..=last).map(|i| taps[i + reach - x] * plane[y * width + i]).sum();
        }
    }
    let mut blurred = vec![0.0; plane.len()];
    for y in 0..height {
        let (first, last) = (y.saturating_sub(reach), (y + reach).min(height - 1));
        for x in 0..width {
            blurred[y * width + x] = (first..=last).map(|i| taps[i + reach - y] * rows[i * width + x]).sum();
        }
    }
    blurred
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
