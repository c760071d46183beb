//! SSIM of two 8-bit RGB images in f64, in parallel over bands of rows.
//!
//! Invariants: every pixel's moments are sums over its window from left to right, then from top to bottom, and the pixels' values are
//! added channel by channel and row by row. So the bits depend neither on the number of threads nor on the width of vectors.

use std::array;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::quality::comparable;
use crate::domain::{Image, PixelMask};

const WINDOW: usize = 11;
const REACH: usize = WINDOW / 2;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Rows of a parallel task. Each task also reads the `REACH` rows above and below.
const BAND: usize = 32;
/// Neighboring pixels that are summed together.
const LANES: usize = 8;
/// Lanes of a tile: the sums of its rows stay in a core's second-level cache.
const TILE_LANES: usize = 32;
const TILE: usize = LANES * TILE_LANES;
/// Means of both images, their squares and their product.
const MOMENTS: usize = 5;

type Lanes = [f64; LANES];
/// A row of a tile and the columns around it that its windows reach.
type Samples = [f64; TILE + 2 * REACH];
/// One moment of a tile's row.
type Row = [Lanes; TILE_LANES];

/// Mean SSIM over pixels and channels: Gaussian window of 11 taps and sigma 1.5 with zero padding (METHOD.md §1.2);
/// `None` if the sizes differ or there is alpha. Allocates eight bytes per pixel.
#[must_use]
pub fn ssim(a: &Image, b: &Image) -> Option<f64> {
    ssim_where(a, b, None)
}

/// As [`ssim`], the mean over the pixels that count; 1 where none does.
pub(super) fn ssim_where(a: &Image, b: &Image, mask: Option<&PixelMask>) -> Option<f64> {
    comparable(a, b)?;
    let counted = mask.map_or(u64::from(a.width()) * u64::from(a.height()), PixelMask::counted);
    if counted == 0 {
        return Some(1.0);
    }
    let (width, height) = (a.width() as usize, a.height() as usize);
    let taps = window();
    let levels = array::from_fn(|level| level as f64 / 255.0);
    let arch = Arch::new();
    let mut values = vec![0.0; width * height];
    let mut total = 0.0;
    for channel in 0..3 {
        let pair = ChannelPair { images: [a, b], channel, taps: &taps, levels: &levels };
        let bands = values.par_chunks_mut(BAND * width).enumerate();
        bands.for_each_init(TileSums::new, |sums, (band, values)| {
            arch.dispatch(BandValues { pair: &pair, sums, top: band * BAND, values });
        });
        match mask {
            None => values.iter().for_each(|value| total += value),
            Some(mask) => {
                let counting = values.iter().zip(mask.iter()).filter(|(_, counts)| *counts);
                counting.for_each(|(value, _)| total += value);
            }
        }
    }
    Some(total / (3 * counted) as f64)
}

fn window() -> [f64; WINDOW] {
    let mut taps: [f64; WINDOW] = array::from_fn(|i| {
        let offset = i as f64 - (WINDOW / 2) as f64;
        (-offset * offset / (2.0 * SIGMA * SIGMA)).exp()
    });
    let sum: f64 = taps.iter().sum();
    taps.iter_mut().for_each(|tap| *tap /= sum);
    taps
}

/// One channel of two images of one size.
struct ChannelPair<'a> {
    images: [&'a Image; 2],
    channel: usize,
    taps: &'a [f64; WINDOW],
    /// The number from 0 to 1 of each 8-bit level.
    levels: &'a [f64; 256],
}

impl ChannelPair<'_> {
    /// Reads the columns of row `y` from `left - REACH` on and multiplies them. Columns outside of the image are zero, which adds
    /// nothing to a sum.
    #[inline(always)]
    fn read(&self, y: usize, left: usize, samples: &mut [Samples; MOMENTS]) {
        let [first, second, rest @ ..] = samples;
        let width = self.images[0].width() as usize;
        let columns = left.saturating_sub(REACH)..(left + TILE + REACH).min(width);
        let padding = REACH.saturating_sub(left);
        for (image, row) in self.images.iter().zip([&mut *first, &mut *second]) {
            row.fill(0.0);
            let pixels = &image.samples().as_chunks::<3>().0[y * width..][columns.clone()];
            for (sample, pixel) in row[padding..].iter_mut().zip(pixels) {
                *sample = self.levels[usize::from(pixel[self.channel])];
            }
        }
        let [squares, other_squares, products] = rest;
        for i in 0..TILE + 2 * REACH {
            squares[i] = first[i] * first[i];
            other_squares[i] = second[i] * second[i];
            products[i] = first[i] * second[i];
        }
    }
}

/// The buffers of a tile.
struct TileSums {
    samples: [Samples; MOMENTS],
    /// Weighted sums along the last `WINDOW` rows, row `y` at `y % WINDOW`.
    across: Vec<[Row; MOMENTS]>,
    moments: [Row; MOMENTS],
}

impl TileSums {
    fn new() -> Self {
        let zero = [[0.0; LANES]; TILE_LANES];
        Self {
            samples: [[0.0; TILE + 2 * REACH]; MOMENTS],
            across: vec![[zero; MOMENTS]; WINDOW],
            moments: [zero; MOMENTS],
        }
    }
}

/// Computes the values of a band's pixels, to be compiled for each kind of vectors that processors have.
struct BandValues<'a> {
    pair: &'a ChannelPair<'a>,
    sums: &'a mut TileSums,
    /// First row.
    top: usize,
    /// Whole rows.
    values: &'a mut [f64],
}

impl WithSimd for BandValues<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) {
        let width = self.pair.images[0].width() as usize;
        for left in (0..width).step_by(TILE) {
            self.tile(left, width);
        }
    }
}

impl BandValues<'_> {
    /// Computes the columns from `left` on.
    #[inline(always)]
    fn tile(&mut self, left: usize, width: usize) {
        let Self { pair, sums, top, values } = self;
        let columns = left..(left + TILE).min(width);
        let lanes = columns.len().div_ceil(LANES);
        let height = pair.images[0].height() as usize;
        for step in 0..values.len() / width + 2 * REACH {
            let across = &mut sums.across[step % WINDOW];
            match (*top + step).checked_sub(REACH).filter(|y| *y < height) {
                Some(y) => {
                    pair.read(y, left, &mut sums.samples);
                    for (samples, sums) in sums.samples.iter().zip(across) {
                        sum_across(pair.taps, samples, &mut sums[..lanes]);
                    }
                }
                // Rows outside of the image are zero.
                None => across.as_flattened_mut().fill([0.0; LANES]),
            }
            let Some(row) = step.checked_sub(2 * REACH) else { continue };
            for (moment, sums_down) in sums.moments.iter_mut().enumerate() {
                let rows: [&Row; WINDOW] = array::from_fn(|tap| &sums.across[(row + tap) % WINDOW][moment]);
                sum_down(pair.taps, rows, &mut sums_down[..lanes]);
            }
            similarities(&sums.moments, &mut values[row * width..][columns.clone()]);
        }
    }
}

/// The weighted sums of each window's columns.
#[inline(always)]
fn sum_across(taps: &[f64; WINDOW], samples: &Samples, sums: &mut [Lanes]) {
    for (samples, sum) in samples.windows(LANES + 2 * REACH).step_by(LANES).zip(sums) {
        let mut lanes = [0.0; LANES];
        if let Some(samples) = samples.first_chunk::<{ LANES + 2 * REACH }>() {
            for tap in 0..WINDOW {
                for lane in 0..LANES {
                    lanes[lane] += taps[tap] * samples[tap + lane];
                }
            }
        }
        *sum = lanes;
    }
}

/// The weighted sums of each window's rows.
#[inline(always)]
fn sum_down(taps: &[f64; WINDOW], rows: [&Row; WINDOW], sums: &mut [Lanes]) {
    for (at, sum) in sums.iter_mut().enumerate() {
        let mut lanes = [0.0; LANES];
        for tap in 0..WINDOW {
            let row = &rows[tap][at];
            for lane in 0..LANES {
                lanes[lane] += taps[tap] * row[lane];
            }
        }
        *sum = lanes;
    }
}

/// SSIM of each pixel.
#[inline(always)]
fn similarities(moments: &[Row; MOMENTS], values: &mut [f64]) {
    let [mx, my, xx, yy, xy] = moments.each_ref().map(|row| row.as_flattened());
    for (((((value, mx), my), xx), yy), xy) in values.iter_mut().zip(mx).zip(my).zip(xx).zip(yy).zip(xy) {
        let (vx, vy, cov) = (xx - mx * mx, yy - my * my, xy - mx * my);
        *value = (2.0 * mx * my + C1) * (2.0 * cov + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2));
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use super::*;

    fn image(width: u32, height: u32, value: impl Fn(usize) -> u8) -> Image {
        let samples = (0..(width * height * 3) as usize).map(value).collect();
        Image::new(width, height, 3, samples).expect("an image")
    }

    /// Noise over a gradient.
    fn noise(width: u32, height: u32, seed: u64, levels: u8) -> Image {
        let value = |i: usize| {
            let mixed = (i as u64 ^ seed).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            let mixed = (mixed ^ mixed >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            (i / 5 % 200) as u8 + ((mixed >> 40) % u64::from(levels)) as u8
        };
        image(width, height, value)
    }

    /// The definition, one sum after the other on one thread: bands of rows with those around them.
    mod sequential {
        use super::*;

        const ROWS: usize = 64;

        pub(super) fn ssim(a: &Image, b: &Image) -> f64 {
            let (width, height) = (a.width() as usize, a.height() as usize);
            let mut total = 0.0;
            for channel in 0..3 {
                for top in (0..height).step_by(ROWS) {
                    let band = Band::new(top, width, height);
                    let (x, y) = (band.plane(a, channel), band.plane(b, channel));
                    let product =
                        |p: &[f64], q: &[f64]| -> Vec<f64> { p.iter().zip(q).map(|(u, v)| u * v).collect() };
                    let smooth = |p: &[f64]| band.blur(p);
                    let (mx, my) = (smooth(&x), smooth(&y));
                    let (xx, yy) = (smooth(&product(&x, &x)), smooth(&product(&y, &y)));
                    let xy = smooth(&product(&x, &y));
                    for i in 0..mx.len() {
                        let (vx, vy) = (xx[i] - mx[i] * mx[i], yy[i] - my[i] * my[i]);
                        let cov = xy[i] - mx[i] * my[i];
                        total += (2.0 * mx[i] * my[i] + C1) * (2.0 * cov + C2)
                            / ((mx[i] * mx[i] + my[i] * my[i] + C1) * (vx + vy + C2));
                    }
                }
            }
            total / (3 * width * height) as f64
        }

        struct Band {
            rows: Range<usize>,
            seen: Range<usize>,
            width: usize,
            height: usize,
        }

        impl Band {
            fn new(top: usize, width: usize, height: usize) -> Self {
                let rows = top..(top + ROWS).min(height);
                let seen = rows.start.saturating_sub(REACH)..(rows.end + REACH).min(height);
                Self { rows, seen, width, height }
            }

            fn plane(&self, image: &Image, channel: usize) -> Vec<f64> {
                let rows = 3 * self.width * self.seen.start..3 * self.width * self.seen.end;
                let samples = image.samples()[rows].iter().skip(channel).step_by(3);
                samples.map(|v| f64::from(*v) / 255.0).collect()
            }

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
    }

    #[test]
    fn ssim_has_the_bits_of_the_sequential_definition() {
        let (band, tile) = (BAND as u32, TILE as u32);
        let sizes = [(1, 1), (3, 7), (10, 5), (11, 11), (7, 2 * band + 1), (9, 4 * band + 7)];
        let across = [(tile - 1, 3), (tile, 2), (tile + 1, band), (tile + 5, band + 1), (2 * tile + 3, 6)];
        for (width, height) in sizes.into_iter().chain(across) {
            let (a, near, far) =
                (noise(width, height, 1, 8), noise(width, height, 2, 8), noise(width, height, 3, 55));
            for (case, b) in [("near", &near), ("far", &far), ("equal", &a)] {
                let found = ssim(&a, b).expect("comparable");
                let wanted = sequential::ssim(&a, b);
                assert_eq!(found.to_bits(), wanted.to_bits(), "{width}x{height}, {case}: {found} {wanted}");
            }
        }
    }

    #[test]
    fn ssim_of_tall_images_is_that_of_every_window() {
        let (width, height) = (9, 4 * BAND + 7);
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
        assert_eq!(ssim(&image(2, 2, |_| 0), &image(3, 2, |_| 0)), None);
    }
}
