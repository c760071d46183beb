//! Projection of one Gaussian (METHOD.md §3.1).

use glam::{DVec2, DVec3};

use super::projected_covariance::{MIN_RATIO, ProjectedCovariance};
use crate::{
    Projection,
    twin::{Cutoffs, Gaussian, Splat},
};

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
