//! Depth in place of color.

use glam::DVec3;

use crate::{Projection, twin::Gaussian};

/// The same Gaussian with its depth as red, and neither green nor blue.
#[must_use]
pub fn shade_depth(projection: &Projection, gaussian: &Gaussian) -> Gaussian {
    let depth = projection.rotation.row(2).dot(gaussian.mean) + projection.translation.z;
    Gaussian { color: DVec3::new(depth, 0.0, 0.0), ..*gaussian }
}
