//! Projection of one Gaussian (METHOD.md §3.1).

use glam::{DMat3, DVec2, DVec3};

use super::{Cutoffs, Gaussian, Projection, Splat};

/// The rotation of a quaternion w, x, y, z of any length but zero.
#[must_use]
pub fn rotation(quat: [f64; 4]) -> DMat3 {
    let norm = quat.iter().map(|v| v * v).sum::<f64>().sqrt();
    let [w, x, y, z] = quat.map(|v| v / norm);
    DMat3::from_cols(
        DVec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        DVec3::new(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        DVec3::new(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
}

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

/// The Gaussian on the image plane, or `None` where it is culled before any tile is looked at.
#[must_use]
pub fn project(projection: &Projection, gaussian: &Gaussian, cutoffs: Cutoffs) -> Option<Splat> {
    let mut numbers = [gaussian.opacity].into_iter().chain(gaussian.quat);
    let finite = gaussian.mean.is_finite() && gaussian.scale.is_finite() && gaussian.color.is_finite();
    let norm: f64 = gaussian.quat.iter().map(|v| v * v).sum();
    if !finite || !numbers.all(f64::is_finite) || norm <= 1e-30 {
        return None;
    }
    let projected = ProjectedCovariance::new(projection, gaussian);
    let position = projected.position;
    if position.z <= projection.near {
        return None;
    }
    let (covariance, determinant, sharp) = projected.covariance(projection.low_pass);
    let mut opacity = gaussian.opacity;
    if projection.antialiased {
        opacity *= (sharp / determinant).max(MIN_RATIO).sqrt();
    }
    if opacity < cutoffs.alpha {
        return None;
    }
    let level = (opacity / cutoffs.alpha).ln();
    let splat = Splat {
        center: projection.focal * position.truncate() / position.z + projection.center,
        depth: position.z,
        opacity,
        conic: DVec3::new(covariance.z, -covariance.y, covariance.x) / determinant,
        extent: (2.0 * level * DVec2::new(covariance.x, covariance.z)).map(f64::sqrt),
        level,
        color: gaussian.color,
    };
    (splat.center.is_finite() && splat.conic.is_finite() && splat.extent.is_finite()).then_some(splat)
}
