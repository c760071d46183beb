//! Plain Gaussians in training, on the host: the layout of their parameters.
//!
//! A Gaussian has 59 values: fourteen base values (mean, log-scales, quaternion, opacity logit, constant color) and 45
//! coefficients of spherical harmonics, three bands of 9, 15 and 21. Each of the four groups is a block of rows of its
//! own, so that a band that is not yet in use costs neither memory traffic nor optimizer steps.

use super::retain_rows;
use crate::domain::{GaussianScene, gaussians::SH_COEFFICIENTS};

/// Base values of a Gaussian.
pub const BASE: usize = 14;
/// First of the three log-scales in a base row; the mean comes before them.
pub const LOG_SCALE: usize = 3;
/// First of the quaternion's w, x, y, z in a base row.
pub const QUAT: usize = 6;
/// The opacity's logit in a base row.
pub const OPACITY: usize = 10;
/// First of the constant color's three coefficients in a base row.
pub const COLOR: usize = 11;
/// Values of each band: red, green, blue of each coefficient in turn.
pub const BANDS: [usize; 3] = [9, 15, 21];
/// The constant basis function of spherical harmonics: a color is this times the coefficient, plus a half.
pub const SH_CONSTANT: f32 = 0.282_094_8;

/// Values of the first `degree` bands together.
#[must_use]
pub fn band_values(degree: usize) -> usize {
    BANDS.iter().take(degree).sum()
}

/// Rows of all Gaussians: parameters, or one of the optimizer's moments.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GaussianRows {
    /// `[N][14]`: mean 3, log-scales 3, quaternion 4 (w, x, y, z), opacity logit, constant color 3.
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

#[cfg(test)]
mod tests {
    use super::*;

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
