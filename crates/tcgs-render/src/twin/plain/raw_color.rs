//! The color of a plain Gaussian from a camera.

use glam::DVec3;

use super::{PlainRow, sh_basis, spherical_harmonics::used};
use crate::{Projection, domain::harmonics::CONSTANT, model::gaussian_rows::COLOR};

pub(super) fn ray(projection: &Projection, row: &PlainRow) -> DVec3 {
    row.three(0) + projection.rotation.transpose() * projection.translation
}

/// The color before it is clamped at zero.
pub(super) fn raw_color(projection: &Projection, row: &PlainRow, degree: u32) -> DVec3 {
    let direction = ray(projection, row).normalize();
    let above = sh_basis(direction).into_iter().zip(row.sh).take(used(degree));
    0.5 + CONSTANT * row.three(COLOR) + above.map(|(b, c)| b * c).sum::<DVec3>()
}
