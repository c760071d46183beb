//! Plain Gaussians in training, on the host: the layout of their parameters and their initial values.
//!
//! A Gaussian has 59 values: fourteen base values (mean, log-scales, quaternion, opacity logit, constant colour) and 45
//! coefficients of spherical harmonics, three bands of 9, 15 and 21. Each of the four groups is a block of rows of its
//! own, so that a band that is not yet in use costs neither memory traffic nor optimiser steps.

use rand::{Rng, RngExt};

use super::{InitError, lattice::neighbour_distances, retain_rows};
use crate::domain::{GaussianScene, gaussians::SH_COEFFICIENTS};

/// Base values of a Gaussian.
pub const BASE: usize = 14;
/// First of the three log-scales in a base row; the mean comes before them.
pub const LOG_SCALE: usize = 3;
/// First of the quaternion's w, x, y, z in a base row.
pub const QUAT: usize = 6;
/// The opacity's logit in a base row.
pub const OPACITY: usize = 10;
/// First of the constant colour's three coefficients in a base row.
pub const COLOR: usize = 11;
/// Values of each band: red, green, blue of each coefficient in turn.
pub const BANDS: [usize; 3] = [9, 15, 21];
/// The constant basis function of spherical harmonics: a colour is this times the coefficient, plus a half.
pub const SH_CONSTANT: f32 = 0.282_094_8;

/// Initial opacity of a Gaussian (METHOD.md §5).
const FIRST_OPACITY: f32 = 0.1;
/// Smallest initial value of a colour channel: one clamped at zero has no gradient and would stay black.
const MIN_COLOR: f32 = 1.0 / 255.0;
/// Smallest neighbour distance for an initial size: the root of the published 1e-7 (METHOD.md §5).
const MIN_SPACING: f32 = 3.162_277_7e-4;

/// Values of the first `degree` bands together.
#[must_use]
pub fn band_values(degree: usize) -> usize {
    BANDS.iter().take(degree).sum()
}

/// Rows of all Gaussians: parameters, or one of the optimiser's moments.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GaussianRows {
    /// `[N][14]`: mean 3, log-scales 3, quaternion 4 (w, x, y, z), opacity logit, constant colour 3.
    pub base: Vec<f32>,
    /// `[N][9]`, `[N][15]` and `[N][21]`: the coefficients of each degree, red, green, blue of each in turn.
    pub bands: [Vec<f32>; 3],
}

impl GaussianRows {
    /// `count` rows of zeros.
    #[must_use]
    pub fn zero(count: usize) -> Self {
        Self { base: vec![0.0; count * BASE], bands: BANDS.map(|width| vec![0.0; count * width]) }
    }

    /// Number of Gaussians.
    #[must_use]
    pub fn len(&self) -> usize {
        self.base.len() / BASE
    }

    /// Whether there is no Gaussian.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.base.is_empty()
    }

    /// The base values of one Gaussian.
    #[must_use]
    pub fn base(&self, index: usize) -> &[f32] {
        &self.base[index * BASE..(index + 1) * BASE]
    }

    /// The base values of one Gaussian, to change.
    pub fn base_mut(&mut self, index: usize) -> &mut [f32] {
        &mut self.base[index * BASE..(index + 1) * BASE]
    }

    /// The coefficients of one Gaussian, all three bands in a row of 45.
    #[must_use]
    pub fn coefficients(&self, index: usize) -> Vec<f32> {
        let bands = self.bands.iter().zip(BANDS);
        bands.flat_map(|(band, width)| &band[index * width..(index + 1) * width]).copied().collect()
    }

    /// Appends a copy of the row `index`.
    pub fn push_copy(&mut self, index: usize) {
        for (block, width) in self.blocks() {
            block.extend_from_within(index * width..(index + 1) * width);
        }
    }

    /// Appends a row of zeros.
    pub fn push_zero(&mut self) {
        for (block, width) in self.blocks() {
            block.resize(block.len() + width, 0.0);
        }
    }

    /// Keeps the rows whose flag is set, in their order.
    pub fn retain(&mut self, keep: &[bool]) {
        for (block, width) in self.blocks() {
            retain_rows(block, width, keep);
        }
    }

    /// The finished scene, with the first `degree` bands.
    #[must_use]
    pub fn to_scene(&self, degree: usize) -> GaussianScene {
        let mut scene = GaussianScene { degree: degree.min(BANDS.len()) as u8, ..GaussianScene::default() };
        for index in 0..self.len() {
            let row = self.base(index);
            scene.means.push(three(row, 0));
            scene.log_scales.push(three(row, LOG_SCALE));
            scene.quats.push(std::array::from_fn(|k| row[QUAT + k]));
            scene.opacity_logits.push(row[OPACITY]);
            let mut sh = [[0.0; 3]; SH_COEFFICIENTS];
            sh[0] = three(row, COLOR);
            let coefficients = self.coefficients(index);
            for (k, to) in sh.iter_mut().skip(1).take(band_values(degree) / 3).enumerate() {
                *to = three(&coefficients, 3 * k);
            }
            scene.sh.push(sh);
        }
        scene
    }

    /// The rows of a scene that [`GaussianScene::check`] finds sound.
    #[must_use]
    pub fn from_scene(scene: &GaussianScene) -> Self {
        let mut rows = Self::zero(scene.len());
        for index in 0..scene.len() {
            let row = rows.base_mut(index);
            row[..LOG_SCALE].copy_from_slice(&scene.means[index]);
            row[LOG_SCALE..QUAT].copy_from_slice(&scene.log_scales[index]);
            row[QUAT..OPACITY].copy_from_slice(&scene.quats[index]);
            row[OPACITY] = scene.opacity_logits[index];
            row[COLOR..].copy_from_slice(&scene.sh[index][0]);
            let mut coefficients = scene.sh[index][1..].as_flattened();
            for (band, width) in rows.bands.iter_mut().zip(BANDS) {
                let (own, rest) = coefficients.split_at(width);
                band[index * width..(index + 1) * width].copy_from_slice(own);
                coefficients = rest;
            }
        }
        rows
    }

    /// Each block with the width of its rows.
    fn blocks(&mut self) -> impl Iterator<Item = (&mut Vec<f32>, usize)> {
        std::iter::once((&mut self.base, BASE)).chain(self.bands.iter_mut().zip(BANDS))
    }
}

fn three(values: &[f32], first: usize) -> [f32; 3] {
    std::array::from_fn(|k| values[first + k])
}

/// Gaussians from points: isotropic, of the size of the distance to their three nearest neighbours, of opacity 0.1, in
/// the points' sRGB colours, or grey with a trace of noise where there are none, as published. Of more than `max_gaussians`
/// points every n-th is taken.
///
/// # Errors
/// [`InitError`] for an empty or non-finite point set.
pub fn initial_gaussians(
    points: &[[f32; 3]],
    colors: &[[u8; 3]],
    max_gaussians: usize,
    rng: &mut impl Rng,
) -> Result<GaussianRows, InitError> {
    if points.is_empty() {
        return Err(InitError::NoPoints);
    }
    if let Some(index) = points.iter().position(|point| point.iter().any(|v| !v.is_finite())) {
        return Err(InitError::NonFinite(index));
    }
    let every = points.len().div_ceil(max_gaussians.max(1));
    let positions: Vec<[f32; 3]> = points.iter().copied().step_by(every).collect();
    let colored = colors.len() == points.len();
    let mut rows = GaussianRows::zero(positions.len());
    let distances = neighbour_distances(&positions);
    for (index, (position, distance)) in positions.iter().zip(distances).enumerate() {
        let color: [f32; 3] = if colored {
            colors[index * every].map(|value| ((f32::from(value) / 255.0).max(MIN_COLOR) - 0.5) / SH_CONSTANT)
        } else {
            std::array::from_fn(|_| rng.random::<f32>() / 255.0)
        };
        let row = rows.base_mut(index);
        row[..LOG_SCALE].copy_from_slice(position);
        row[LOG_SCALE..QUAT].fill(distance.max(MIN_SPACING).ln());
        row[QUAT] = 1.0;
        row[OPACITY] = logit(FIRST_OPACITY);
        row[COLOR..].copy_from_slice(&color);
    }
    Ok(rows)
}

/// The value whose logistic is `probability`.
#[must_use]
pub fn logit(probability: f32) -> f32 {
    (probability / (1.0 - probability)).ln()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_pcg::Pcg64;

    use super::*;

    fn begin(points: &[[f32; 3]], colors: &[[u8; 3]], most: usize) -> Result<GaussianRows, InitError> {
        initial_gaussians(points, colors, most, &mut Pcg64::seed_from_u64(1))
    }

    fn grid() -> Vec<[f32; 3]> {
        (0..1000).map(|i| [(i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32]).collect()
    }

    #[test]
    fn gaussians_begin_as_balls_that_fill_the_spacing_in_the_colours_of_their_points() {
        // Black is lifted by one: what is held at zero does not learn.
        let colors: Vec<[u8; 3]> = (0..1000).map(|i| [(i % 256) as u8, 0, 255]).collect();
        let rows = begin(&grid(), &colors, 1000).expect("rows");
        assert_eq!((rows.len(), rows.bands.each_ref().map(Vec::len)), (1000, [9_000, 15_000, 21_000]));
        for (index, point) in grid().iter().enumerate() {
            let row = rows.base(index);
            assert_eq!(row[..3], *point);
            // Three neighbours at distance one.
            assert!(row[LOG_SCALE..QUAT].iter().all(|log| log.abs() < 1e-6), "{row:?}");
            assert_eq!(row[QUAT..OPACITY], [1.0, 0.0, 0.0, 0.0]);
            assert!((1.0 / (1.0 + (-row[OPACITY]).exp()) - 0.1).abs() < 1e-6);
            let color = [0, 1, 2].map(|c| row[COLOR + c] * SH_CONSTANT + 0.5);
            for (found, expected) in color.iter().zip(colors[index]) {
                assert!((found - f32::from(expected.max(1)) / 255.0).abs() < 1e-6);
            }
            assert!(rows.coefficients(index).iter().all(|v| *v == 0.0));
        }
    }

    #[test]
    fn points_without_colours_begin_grey_and_too_many_points_are_thinned() {
        let rows = begin(&grid(), &[], 300).expect("rows");
        assert_eq!(rows.len(), 250, "every fourth of a thousand");
        let reds: Vec<f32> = (0..250).map(|i| rows.base(i)[COLOR] * SH_CONSTANT + 0.5).collect();
        assert!(reds.iter().all(|red| (0.5..0.502).contains(red)));
        assert!(reds.windows(2).any(|pair| pair[0] != pair[1]), "no two alike for good");
        assert_eq!(rows.base(1)[..3], grid()[4]);
    }

    #[test]
    fn coinciding_points_and_a_lone_one_have_a_finite_size_and_unusable_ones_are_named() {
        for points in [vec![[1.0, 2.0, 3.0]], vec![[1.0, 2.0, 3.0]; 9]] {
            let rows = begin(&points, &[], 100).expect("rows");
            assert!(rows.base.iter().all(|v| v.is_finite()));
        }
        assert_eq!(begin(&[], &[], 9), Err(InitError::NoPoints));
        assert_eq!(begin(&[[0.0; 3], [f32::NAN, 0.0, 0.0]], &[], 9), Err(InitError::NonFinite(1)));
    }

    #[test]
    fn rows_are_copied_and_retained_in_all_blocks() {
        let mut rows = GaussianRows::zero(3);
        for index in 0..3 {
            rows.base_mut(index).fill(index as f32);
            for (band, width) in rows.bands.iter_mut().zip(BANDS) {
                band[index * width..(index + 1) * width].fill(index as f32);
            }
        }
        rows.push_copy(1);
        rows.push_zero();
        rows.retain(&[true, false, true, true, true]);
        assert_eq!(rows.len(), 4);
        for (index, value) in [0.0, 2.0, 1.0, 0.0].into_iter().enumerate() {
            assert!(rows.base(index).iter().all(|v| *v == value), "row {index}");
            assert!(rows.coefficients(index).iter().all(|v| *v == value), "row {index}");
        }
        assert_eq!([0, 1, 2, 3].map(band_values), [0, 9, 24, 45]);
    }

    #[test]
    fn rows_become_a_scene_and_a_scene_rows() {
        let mut rows = GaussianRows::zero(2);
        let blocks = std::iter::once(&mut rows.base).chain(&mut rows.bands);
        for (at, value) in blocks.flatten().enumerate() {
            *value = at as f32;
        }
        let scene = rows.to_scene(3);
        scene.check().expect("a sound scene");
        assert_eq!(GaussianRows::from_scene(&scene), rows);
        assert_eq!(scene.means[1], [14.0, 15.0, 16.0]);
        // The second Gaussian's coefficients: its constant one, the first of band one, the last of band three.
        assert_eq!([0, 1, 15].map(|k| scene.sh[1][k][0]), [25.0, 37.0, 115.0]);
        let flat = rows.to_scene(1);
        assert_eq!((flat.degree, flat.sh[1][3], flat.sh[1][4]), (1, scene.sh[1][3], [0.0; 3]));
    }
}
