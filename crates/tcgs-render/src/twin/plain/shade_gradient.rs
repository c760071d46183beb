//! From the gradients by Gaussians to those by the parameters of plain Gaussians.

use glam::DVec3;

use super::{
    PlainRow,
    raw_color::{raw_color, ray},
    sh_basis, sh_slopes,
    spherical_harmonics::used,
};
use crate::{
    Projection,
    domain::harmonics::CONSTANT,
    model::gaussian_rows::{COLOR, LOG_SCALE, OPACITY, QUAT},
    twin::{Gaussian, GaussianGradient},
};

/// The gradient by the parameters of a Gaussian that reached the image, from that by the Gaussian.
#[must_use]
pub fn shade_gradient(
    projection: &Projection,
    row: &PlainRow,
    degree: u32,
    gaussian: &Gaussian,
    d: &GaussianGradient,
) -> PlainRow {
    let clamped = raw_color(projection, row, degree).cmple(DVec3::ZERO);
    let v = DVec3::select(clamped, DVec3::ZERO, d.color);
    let ray = ray(projection, row);
    let direction = ray.normalize();
    let mut gradient = PlainRow::ZERO;
    let mut slope = DVec3::ZERO;
    let (basis, slopes) = (sh_basis(direction), sh_slopes(direction));
    for k in 0..used(degree) {
        gradient.sh[k] = basis[k] * v;
        slope += slopes[k] * row.sh[k].dot(v);
    }
    let by_ray = (slope - direction * direction.dot(slope)) / ray.length();
    (d.mean + by_ray).write_to_slice(&mut gradient.base);
    (d.scale * gaussian.scale).write_to_slice(&mut gradient.base[LOG_SCALE..]);
    gradient.base[QUAT..OPACITY].copy_from_slice(&d.quat);
    gradient.base[OPACITY] = d.opacity * gaussian.opacity * (1.0 - gaussian.opacity);
    (CONSTANT * v).write_to_slice(&mut gradient.base[COLOR..]);
    gradient
}
