//! The parameters of a plain Gaussian.

use glam::DVec3;

use crate::model::gaussian_rows::BASE;

/// The parameters of one plain Gaussian, or the gradient by them.
#[derive(Debug, Clone, PartialEq)]
pub struct PlainRow {
    /// Mean 3, log-scales 3, quaternion 4 (w, x, y, z), opacity logit, constant color 3.
    pub base: [f64; BASE],
    /// The fifteen coefficients above the constant one, by degree.
    pub sh: [DVec3; 15],
}

impl PlainRow {
    /// All zeros.
    pub const ZERO: Self = Self { base: [0.0; BASE], sh: [DVec3::ZERO; 15] };

    pub(super) fn three(&self, first: usize) -> DVec3 {
        DVec3::from_slice(&self.base[first..first + 3])
    }
}
