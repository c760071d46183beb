//! Basis functions of spherical harmonics, and their gradients.

use glam::DVec3;

use crate::domain::harmonics::basis;

/// Coefficients above the constant one in use at `degree`.
pub(super) fn used(degree: u32) -> usize {
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
