//! From the parameters of plain Gaussians to Gaussians.

use glam::DVec3;

use super::{PlainRow, raw_color::raw_color};
use crate::{
    Projection,
    model::gaussian_rows::{LOG_SCALE, OPACITY, QUAT},
    twin::Gaussian,
};

/// Opacities below this reach no pixel.
const ALPHA_MIN: f64 = 1.0 / 255.0;

/// The Gaussian, or none where it is behind the near plane or too transparent to reach a pixel.
#[must_use]
pub fn shade_gaussians(projection: &Projection, row: &PlainRow, degree: u32) -> Option<Gaussian> {
    let mean = row.three(0);
    let depth = projection.rotation.row(2).dot(mean) + projection.translation.z;
    let opacity = 1.0 / (1.0 + (-row.base[OPACITY]).exp());
    (depth > projection.near && opacity >= ALPHA_MIN).then(|| Gaussian {
        mean,
        opacity,
        scale: row.three(LOG_SCALE).map(f64::exp),
        quat: [0, 1, 2, 3].map(|k| row.base[QUAT + k]),
        color: raw_color(projection, row, degree).max(DVec3::ZERO),
    })
}
