//! From the parameters of plain Gaussians to Gaussians and back, and the statistics of their growth, on the CPU in f64.
//!
//! Spherical harmonics as published with the method, signs included: a colour is a half plus the sum of coefficients
//! times basis functions of the unit vector from the camera to the mean, clamped at zero.

use glam::{DVec2, DVec3};

use super::{Gaussian, GaussianGradient, Projection};
use crate::{
    domain::harmonics::{CONSTANT, basis},
    model::gaussian_rows::{BASE, COLOR, LOG_SCALE, OPACITY, QUAT},
};

/// Opacities below this reach no pixel.
const ALPHA_MIN: f64 = 1.0 / 255.0;

/// The parameters of one plain Gaussian, or the gradient by them.
#[derive(Debug, Clone, PartialEq)]
pub struct PlainRow {
    /// Mean 3, log-scales 3, quaternion 4 (w, x, y, z), opacity logit, constant colour 3.
    pub base: [f64; BASE],
    /// The fifteen coefficients above the constant one, by degree.
    pub sh: [DVec3; 15],
}

impl PlainRow {
    /// All zeros.
    pub const ZERO: Self = Self { base: [0.0; BASE], sh: [DVec3::ZERO; 15] };

    fn three(&self, first: usize) -> DVec3 {
        DVec3::from_slice(&self.base[first..first + 3])
    }
}

/// Coefficients above the constant one in use at `degree`.
fn used(degree: u32) -> usize {
    let degree = degree as usize;
    degree * (degree + 2)
}

/// The fifteen basis functions above the constant one at `d`.
#[must_use]
pub fn sh_basis(d: DVec3) -> [f64; 15] {
    let [_, above @ ..] = basis(d);
    above
}

/// The gradients of the basis functions by `d`, not constrained to the sphere.
#[must_use]
pub fn sh_slopes(d: DVec3) -> [DVec3; 15] {
    let DVec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let v = DVec3::new;
    [
        0.488_602_511_902_919_9 * v(0.0, -1.0, 0.0),
        0.488_602_511_902_919_9 * v(0.0, 0.0, 1.0),
        0.488_602_511_902_919_9 * v(-1.0, 0.0, 0.0),
        1.092_548_430_592_079_2 * v(y, x, 0.0),
        -1.092_548_430_592_079_2 * v(0.0, z, y),
        0.315_391_565_252_520_05 * v(-2.0 * x, -2.0 * y, 4.0 * z),
        -1.092_548_430_592_079_2 * v(z, 0.0, x),
        0.546_274_215_296_039_6 * v(2.0 * x, -2.0 * y, 0.0),
        -0.590_043_589_926_643_5 * v(6.0 * x * y, 3.0 * xx - 3.0 * yy, 0.0),
        2.890_611_442_640_554 * v(y * z, x * z, x * y),
        -0.457_045_799_464_465_8 * v(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z),
        0.373_176_332_590_115_4 * v(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_464_465_8 * v(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z),
        1.445_305_721_320_277 * v(2.0 * x * z, -2.0 * y * z, xx - yy),
        -0.590_043_589_926_643_5 * v(3.0 * xx - 3.0 * yy, -6.0 * x * y, 0.0),
    ]
}

fn ray(projection: &Projection, row: &PlainRow) -> DVec3 {
    row.three(0) + projection.rotation.transpose() * projection.translation
}

/// The colour before it is clamped at zero.
fn raw_color(projection: &Projection, row: &PlainRow, degree: u32) -> DVec3 {
    let direction = ray(projection, row).normalize();
    let above = sh_basis(direction).into_iter().zip(row.sh).take(used(degree));
    0.5 + CONSTANT * row.three(COLOR) + above.map(|(b, c)| b * c).sum::<DVec3>()
}

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

/// Adds one view to a Gaussian's row of statistics: sum of screen-gradient norms in half-image units, count of views,
/// largest radius in pixels. `center` is the gradient by the projected centre; a Gaussian of no `tiles` is culled.
pub fn gaussian_statistics(
    projection: &Projection,
    center: DVec2,
    tiles: u32,
    radius: f64,
    row: &mut [f64; 3],
) {
    if tiles > 0 {
        row[0] += (center * 0.5 * projection.size.as_dvec2()).length();
        row[1] += 1.0;
        row[2] = row[2].max(radius);
    }
}
