//! The rotation of a quaternion.

use glam::{DMat3, DVec3};

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
