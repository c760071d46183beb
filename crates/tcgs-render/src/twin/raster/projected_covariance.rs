//! What both directions of the projection share: Jacobian, axes and covariance (METHOD.md §3.1).

use glam::{DVec2, DVec3};

use super::rotation;
use crate::{Projection, twin::Gaussian};

/// Shared by both directions of the projection: camera position, slopes inside the Jacobian, its rows in world axes,
/// and their products with the Gaussian's scaled axes.
pub(super) struct ProjectedCovariance {
    pub(super) position: DVec3,
    pub(super) slope: DVec2,
    pub(super) rows: [DVec3; 2],
    pub(super) axes: [DVec3; 3],
    pub(super) products: [DVec3; 2],
}

impl ProjectedCovariance {
    pub(super) fn new(projection: &Projection, gaussian: &Gaussian) -> Self {
        let view = projection.rotation;
        let position = view * gaussian.mean + projection.translation;
        let (low, high) = projection.slopes();
        let slope = (position.truncate() / position.z).clamp(low, high);
        let rows = [0, 1].map(|i| projection.focal[i] / position.z * (view.row(i) - slope[i] * view.row(2)));
        let turn = rotation(gaussian.quat);
        let axes = [0, 1, 2].map(|k| turn.col(k));
        let products = rows.map(|row| DVec3::from(axes.map(|axis| row.dot(axis))) * gaussian.scale);
        Self { position, slope, rows, axes, products }
    }

    /// Covariance a, b, c with the low-pass filter, its determinant, and the determinant without the filter.
    pub(super) fn covariance(&self, low_pass: f64) -> (DVec3, f64, f64) {
        let [u, v] = self.products;
        let sharp = u.cross(v).length_squared();
        let blurred = sharp + low_pass * (u.length_squared() + v.length_squared() + low_pass);
        (DVec3::new(u.length_squared() + low_pass, u.dot(v), v.length_squared() + low_pass), blurred, sharp)
    }
}

/// The square of the smallest compensation that antialiasing applies.
pub(super) const MIN_RATIO: f64 = 0.005 * 0.005;
