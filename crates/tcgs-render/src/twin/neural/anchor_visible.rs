//! Whether a view shows an anchor.

use glam::{DVec2, DVec3};

use crate::{Projection, model::ModelShape};

/// Whether the three-sigma box of the anchor, projected as an axis-aligned Gaussian of its offset scale, touches the
/// image (METHOD.md §2.3).
#[must_use]
pub fn anchor_visible(projection: &Projection, position: DVec3, shape: ModelShape, row: &[f64]) -> bool {
    // A constant of this test, independent of the rasterizer's settings.
    const LOW_PASS: f64 = 0.3;
    let view = projection.rotation;
    let p = view * position + projection.translation;
    let beyond_near = p.z > projection.near;
    if !beyond_near {
        return false;
    }
    let reach = DVec3::from_slice(&row[shape.scaling_column()..][..3]).map(f64::exp);
    let (low, high) = projection.slopes();
    let slope = (p.truncate() / p.z).clamp(low, high);
    let variance = DVec2::from([0, 1].map(|i| {
        let across = projection.focal[i] / p.z * (view.row(i) - slope[i] * view.row(2)) * reach;
        across.length_squared() + LOW_PASS
    }));
    let radius = 3.0 * variance.map(f64::sqrt);
    let center = projection.focal * p.truncate() / p.z + projection.center;
    (center + radius).cmpgt(DVec2::ZERO).all() && (center - radius).cmplt(projection.size.as_dvec2()).all()
}
