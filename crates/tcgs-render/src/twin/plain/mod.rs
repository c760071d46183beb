//! From the parameters of plain Gaussians to Gaussians and back, and the statistics of their growth, on the CPU in f64.
//!
//! Spherical harmonics as published with the method, signs included: a color is a half plus the sum of coefficients
//! times basis functions of the unit vector from the camera to the mean, clamped at zero.

mod gaussian_statistics;
mod plain_row;
mod raw_color;
mod shade_gaussians;
mod shade_gradient;
mod spherical_harmonics;

pub use gaussian_statistics::gaussian_statistics;
pub use plain_row::PlainRow;
pub use shade_gaussians::shade_gaussians;
pub use shade_gradient::shade_gradient;
pub use spherical_harmonics::{sh_basis, sh_slopes};
