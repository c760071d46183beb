//! Affine color corrections that fit a render to its photograph: from the left half of a view, measured on the right half
//! (METHOD.md §1.2).
//!
//! Images have 8 bits before and after a correction. Only pixels that count are fitted and measured.

use glam::{DMat4, DVec3, DVec4};

use super::{Target, quality::PSNR_CEILING};
use crate::domain::{ColorFitScores, Image};

/// Weight of the identity against a pixel, so that a view of one color has a fit too.
const IDENTITY_WEIGHT: f64 = 1e-5;

/// An affine correction of colors in [0, 1]: three rows, each a row of A and then the component of b.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColorFit {
    rows: [DVec4; 3],
}

/// What a correction is fitted to: sums over the pixels of left halves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LeftHalf {
    pixels: f64,
    /// Of products of the render's color and 1 with themselves.
    normal: DMat4,
    /// Of products of them with the photograph's channels.
    products: [DVec4; 3],
}

/// A view's right half, in dB.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RightHalf {
    /// PSNR as rendered.
    pub psnr: f64,
    /// PSNR with the correction that fits the left half.
    pub corrected_psnr: f64,
}

fn color(pixel: &[u8]) -> DVec4 {
    DVec4::new(f64::from(pixel[0]), f64::from(pixel[1]), f64::from(pixel[2]), 255.0) / 255.0
}

/// No pixels.
impl Default for LeftHalf {
    fn default() -> Self {
        // The matrix's own default is the identity.
        Self { pixels: 0.0, normal: DMat4::ZERO, products: [DVec4::ZERO; 3] }
    }
}

impl LeftHalf {
    /// Both halves as one.
    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        Self {
            pixels: self.pixels + other.pixels,
            normal: self.normal + other.normal,
            products: [0, 1, 2].map(|channel| self.products[channel] + other.products[channel]),
        }
    }

    fn add(&mut self, render: &[u8], photograph: &[u8]) {
        let (from, to) = (color(render), color(photograph));
        self.pixels += 1.0;
        self.normal += DMat4::from_cols(from * from.x, from * from.y, from * from.z, from);
        for (product, value) in self.products.iter_mut().zip(to.to_array()) {
            *product += value * from;
        }
    }

    /// The correction of the least squared error.
    #[must_use]
    pub fn fit(&self) -> ColorFit {
        let normal = self.normal + IDENTITY_WEIGHT * self.pixels.max(1.0) * DMat4::IDENTITY;
        let identity = [DVec4::X, DVec4::Y, DVec4::Z];
        // What differs from the identity, so that a view that is right already has exactly that.
        let row = |channel: usize| {
            identity[channel] + solved(normal, self.products[channel] - self.normal * identity[channel])
        };
        ColorFit { rows: [0, 1, 2].map(row) }
    }
}

/// The solution of `matrix x = right` for a positive definite matrix, by elimination: an explicit inverse loses digits where a view has
/// nearly one color.
fn solved(matrix: DMat4, right: DVec4) -> DVec4 {
    let mut rows = [0, 1, 2, 3].map(|row| (matrix.row(row), right[row]));
    for pivot in 0..4 {
        let (from, value) = rows[pivot];
        for (row, other) in &mut rows[pivot + 1..] {
            let share = row[pivot] / from[pivot];
            *row -= share * from;
            *other -= share * value;
        }
    }
    let mut solution = DVec4::ZERO;
    for place in (0..4).rev() {
        // Components that are not solved yet are zero.
        let (row, value) = rows[place];
        solution[place] = (value - row.dot(solution)) / row[place];
    }
    solution
}

/// Rows as they are learnt.
impl From<[[f32; 4]; 3]> for ColorFit {
    fn from(rows: [[f32; 4]; 3]) -> Self {
        Self { rows: rows.map(|row| DVec4::from(row.map(f64::from))) }
    }
}

impl ColorFit {
    /// A corrected color, not clamped.
    #[must_use]
    pub fn corrected(&self, color: [f32; 3]) -> [f32; 3] {
        let color = DVec3::from(color.map(f64::from)).extend(1.0);
        self.rows.map(|row| row.dot(color) as f32)
    }

    /// The gradient by a color, of the one by the corrected color: the product with the transpose of A.
    #[must_use]
    pub fn transposed(&self, gradient: [f32; 3]) -> [f32; 3] {
        let parts = self.rows.iter().zip(gradient).map(|(row, d)| f64::from(d) * row.truncate());
        parts.sum::<DVec3>().as_vec3().to_array()
    }

    /// A corrected RGB image; `None` for an image of other channels.
    #[must_use]
    pub fn image(&self, image: &Image) -> Option<Image> {
        if image.channels() != 3 {
            return None;
        }
        let samples = image.samples().chunks_exact(3).flat_map(|pixel| self.apply(pixel)).collect();
        Image::new(image.width(), image.height(), 3, samples).ok()
    }

    /// The corrected pixel in 8 bits.
    fn apply(&self, pixel: &[u8]) -> [u8; 3] {
        let from = color(pixel);
        self.rows.map(|row| (255.0 * row.dot(from)).round().clamp(0.0, 255.0) as u8)
    }
}

impl Target {
    /// The sums over the left half of a view: the columns before the middle one. `None` if no pixel of it counts, or the render is not of
    /// the photograph's shape.
    #[must_use]
    pub fn left_half(&self, render: &Image) -> Option<LeftHalf> {
        let mut sums = LeftHalf::default();
        self.for_each_pixel(render, |is_left, from, to| {
            if is_left {
                sums.add(from, to);
            }
        })?;
        (sums.pixels > 0.0).then_some(sums)
    }

    /// PSNR over the right half of a view in dB, with a correction or as rendered. `None` if no pixel of it counts, or the render is not
    /// of the photograph's shape.
    #[must_use]
    pub fn right_half_psnr(&self, render: &Image, fit: Option<&ColorFit>) -> Option<f64> {
        let (mut squares, mut samples) = (0_u64, 0_u64);
        self.for_each_pixel(render, |is_left, from, to| {
            if !is_left {
                let from = fit.map_or([from[0], from[1], from[2]], |fit| fit.apply(from));
                squares += from.iter().zip(to).map(|(a, b)| u64::from(a.abs_diff(*b)).pow(2)).sum::<u64>();
                samples += 3;
            }
        })?;
        let mse = squares as f64 / (255.0 * 255.0) / samples as f64;
        (samples > 0).then(|| if mse > 0.0 { (-10.0 * mse.log10()).min(PSNR_CEILING) } else { PSNR_CEILING })
    }

    /// A view's right half with and without the correction that fits the left one. `None` if either half has no pixel that counts, or the
    /// render is not of the photograph's shape.
    #[must_use]
    pub fn right_half(&self, render: &Image) -> Option<RightHalf> {
        let fit = self.left_half(render)?.fit();
        Some(RightHalf {
            psnr: self.right_half_psnr(render, None)?,
            corrected_psnr: self.right_half_psnr(render, Some(&fit))?,
        })
    }

    /// Calls `each` for every pixel that counts: whether it is in the left half, the render's samples and the photograph's.
    fn for_each_pixel(&self, render: &Image, mut each: impl FnMut(bool, &[u8], &[u8])) -> Option<()> {
        super::quality::comparable(render, self.photograph())?;
        let width = render.width() as usize;
        let mut mask = self.mask().map(|mask| mask.iter());
        let pixels = render.samples().chunks_exact(3).zip(self.photograph().samples().chunks_exact(3));
        for (index, (from, to)) in pixels.enumerate() {
            if mask.as_mut().is_none_or(|mask| mask.next().unwrap_or(false)) {
                each(index % width < width / 2, from, to);
            }
        }
        Some(())
    }
}

/// The means over views; `None` without views.
#[must_use]
pub fn mean_color_fit(halves: &[RightHalf]) -> Option<ColorFitScores> {
    let mean = |of: fn(&RightHalf) -> f64| halves.iter().map(of).sum::<f64>() / halves.len() as f64;
    (!halves.is_empty()).then(|| ColorFitScores {
        views: halves.len(),
        psnr: mean(|half| half.psnr),
        corrected_psnr: mean(|half| half.corrected_psnr),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{domain::PixelMask, eval::psnr};

    fn image(width: u32, height: u32, seed: u32) -> Image {
        let value = |i: u32| 40 + ((i.wrapping_mul(seed).wrapping_mul(2_654_435_761) >> 24) / 2) as u8;
        Image::new(width, height, 3, (0..width * height * 3).map(value).collect()).expect("an image")
    }

    fn map(image: &Image, of: impl Fn(&[u8]) -> [u8; 3]) -> Image {
        let samples = image.samples().chunks_exact(3).flat_map(of).collect();
        Image::new(image.width(), image.height(), 3, samples).expect("an image")
    }

    fn exposed(pixel: &[u8]) -> [u8; 3] {
        let [r, g, b] = [0, 1, 2].map(|channel| f64::from(pixel[channel]));
        [0.5 * r + 0.1 * g + 20.0, 1.3 * g, 0.9 * b + 0.2 * r - 10.0].map(|value| value.round() as u8)
    }

    #[test]
    fn an_affine_change_is_found_from_the_left_half_and_taken_back_in_the_right_one() {
        let render = image(40, 30, 3);
        let target = Target::new(map(&render, exposed), None);
        let half = target.right_half(&render).expect("comparable");
        assert!(half.psnr < 21.0 && half.corrected_psnr > 50.0, "{half:?}");
        let same = Target::new(render.clone(), None).right_half(&render).expect("comparable");
        assert_eq!(same, RightHalf { psnr: PSNR_CEILING, corrected_psnr: PSNR_CEILING });
    }

    #[test]
    fn the_right_half_alone_is_measured_and_the_left_one_alone_fitted() {
        let (render, other) = (image(41, 8, 3), image(41, 8, 7));
        let half = |image: &Image, columns: std::ops::Range<usize>| {
            let rows = image.samples().chunks_exact(3 * 41);
            let samples = rows.flat_map(|row| row[3 * columns.start..3 * columns.end].to_vec()).collect();
            Image::new(columns.len() as u32, 8, 3, samples).expect("an image")
        };
        let found = Target::new(other.clone(), None).right_half(&render).expect("comparable");
        let expected = psnr(&half(&render, 20..41), &half(&other, 20..41)).expect("comparable");
        assert!((found.psnr - expected).abs() < 1e-9);
        // What differs in the right half has no part in the fit.
        let mut samples = map(&render, exposed).samples().to_vec();
        samples.chunks_exact_mut(3 * 41).for_each(|row| row[60..].fill(0));
        let cut = Target::new(Image::new(41, 8, 3, samples).expect("an image"), None);
        let whole = Target::new(map(&render, exposed), None);
        assert_eq!(cut.left_half(&render), whole.left_half(&render));
        assert_eq!(cut.left_half(&image(40, 8, 3)), None);
    }

    #[test]
    fn pixels_that_do_not_count_have_no_part() {
        let render = image(40, 30, 3);
        let mask = PixelMask::from_fn(40, 30, |x, y| (x + y) % 3 > 0);
        let painted = |red: u8| {
            let pixels = render.samples().chunks_exact(3).zip(mask.iter());
            let samples = pixels.flat_map(|(p, counts)| if counts { exposed(p) } else { [red, 0, 9] });
            Image::new(40, 30, 3, samples.collect()).expect("an image")
        };
        let half = |red| Target::new(painted(red), Some(mask.clone())).right_half(&render);
        assert_eq!(half(3), half(250));
        assert!(half(3).expect("comparable").corrected_psnr > 50.0);
    }

    #[test]
    fn a_view_of_one_color_has_a_fit() {
        let gray = |level: u8| Image::new(6, 4, 3, vec![level; 72]).expect("an image");
        let half = Target::new(gray(120), None).right_half(&gray(100)).expect("comparable");
        assert!(half.corrected_psnr > 45.0, "{half:?}");
    }

    #[test]
    fn a_view_of_which_one_half_does_not_count_has_no_figures() {
        let render = image(6, 4, 3);
        let masked = |counts: fn(u32) -> bool| {
            let mask = PixelMask::from_fn(6, 4, |x, _| counts(x));
            Target::new(map(&render, exposed), Some(mask))
        };
        let (left, right) = (masked(|x| x < 3), masked(|x| x > 2));
        assert_eq!([left.right_half(&render), right.right_half(&render)], [None; 2]);
        assert_eq!((left.right_half_psnr(&render, None), right.left_half(&render)), (None, None));
        assert!(left.left_half(&render).is_some() && right.right_half_psnr(&render, None).is_some());
        assert_eq!(masked(|_| false).right_half(&render), None);
        assert!(masked(|x| x == 2 || x == 3).right_half(&render).is_some());
        // A column alone is all right half.
        let column = Image::new(1, 4, 3, vec![9; 12]).expect("an image");
        assert_eq!(Target::new(column.clone(), None).right_half(&column), None);
    }

    #[test]
    fn means_are_over_views() {
        let half = |psnr| RightHalf { psnr, corrected_psnr: psnr + 3.0 };
        let mean = mean_color_fit(&[half(20.0), half(30.0)]).expect("views");
        assert_eq!(mean, ColorFitScores { views: 2, psnr: 25.0, corrected_psnr: 28.0 });
        assert_eq!(mean_color_fit(&[]), None);
    }
}
