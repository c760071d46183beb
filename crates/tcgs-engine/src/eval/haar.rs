//! One level of the two-dimensional Haar transform and its adjoint, in f64.
//!
//! Orthonormal; an odd side is padded with one zero at its end (METHOD.md §4.7, as PyWavelets' mode `zero`). Images and
//! bands are one RGB triple a place, rows from the top.

use glam::{DVec3, USizeVec2};

/// A level of the transform: bands of half the image's size, rounded up.
#[derive(Debug, Clone, PartialEq)]
pub struct Haar {
    /// Size of each band.
    pub size: USizeVec2,
    /// LL: half the sum of each 2 x 2 block.
    pub low: Vec<DVec3>,
    /// LH, HL and HH: half the differences of rows, of columns, and of both.
    pub high: [Vec<DVec3>; 3],
}

impl Haar {
    /// The transform of an image of `size`.
    #[must_use]
    pub fn of(size: USizeVec2, image: &[DVec3]) -> Self {
        let half = (size + 1) / 2;
        let at =
            |x: usize, y: usize| if x < size.x && y < size.y { image[y * size.x + x] } else { DVec3::ZERO };
        let blocks = (0..half.x * half.y).map(|block| {
            let (x, y) = (2 * (block % half.x), 2 * (block / half.x));
            [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)]
        });
        let band = |signs: [f64; 4]| {
            let sum = |block: [DVec3; 4]| block.iter().zip(signs).map(|(v, sign)| 0.5 * sign * *v).sum();
            blocks.clone().map(sum).collect()
        };
        Self {
            size: half,
            low: band([1.0; 4]),
            high: [[1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0], [1.0, -1.0, -1.0, 1.0]].map(band),
        }
    }

    /// The adjoint, which is the inverse too: the image of `size` that has these bands, without the padding.
    #[must_use]
    pub fn image(&self, size: USizeVec2) -> Vec<DVec3> {
        let pixel = |index: usize| {
            let (x, y) = (index % size.x, index / size.x);
            let block = (y / 2) * self.size.x + x / 2;
            let sign = |odd: bool| if odd { -1.0 } else { 1.0 };
            let (row, column) = (sign(y % 2 == 1), sign(x % 2 == 1));
            let [lh, hl, hh] = &self.high;
            0.5 * (self.low[block] + row * lh[block] + column * hl[block] + row * column * hh[block])
        };
        (0..size.x * size.y).map(pixel).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_adjoint_is_the_inverse_whatever_the_size() {
        for (width, height) in [(4, 6), (5, 3), (1, 1), (7, 2)] {
            let size = USizeVec2::new(width, height);
            let image: Vec<DVec3> = (0..width * height)
                .map(|i| DVec3::new((i * 37 % 11) as f64, (i * 5 % 7) as f64, -(i as f64)) / 8.0)
                .collect();
            let level = Haar::of(size, &image);
            assert_eq!(level.size, USizeVec2::new(width.div_ceil(2), height.div_ceil(2)));
            assert_eq!(level.image(size), image, "eighths are exact");
        }
    }
}
