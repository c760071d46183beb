//! Gradients of the projection (METHOD.md §3.3), with the clamp and the antialiasing of §3.1.

use glam::{DMat2, DMat3, DVec2, DVec3};

use super::projected_covariance::{MIN_RATIO, ProjectedCovariance};
use crate::{
    Projection,
    twin::{Gaussian, GaussianGradient, SplatGradient},
};

/// Gradients by the Gaussian from those by its splat.
#[must_use]
pub fn project_backward(projection: &Projection, gaussian: &Gaussian, v: &SplatGradient) -> GaussianGradient {
    let projected = ProjectedCovariance::new(projection, gaussian);
    let (covariance, determinant, sharp) = projected.covariance(projection.low_pass);
    let conic = DMat2::from_cols_array(&[covariance.z, -covariance.y, -covariance.y, covariance.x])
        * determinant.recip();

    // dC = -K dK K for symmetric matrices.
    let d_conic = DMat2::from_cols_array(&[v.conic.x, 0.5 * v.conic.y, 0.5 * v.conic.y, v.conic.z]);
    let mut d_covariance = -(conic * d_conic * conic);
    let mut d_opacity = v.opacity;
    if projection.antialiased {
        let ratio = sharp / determinant;
        let compensation = ratio.max(MIN_RATIO).sqrt();
        d_opacity *= compensation;
        if ratio > MIN_RATIO {
            let d_ratio = v.opacity * gaussian.opacity / (2.0 * compensation);
            d_covariance +=
                d_ratio * ((1.0 - ratio) * conic - projection.low_pass / determinant * DMat2::IDENTITY);
        }
    }

    // C = N Nᵀ, N = rows · axes · diag(scale).
    let [nu, nv] = projected.products;
    let d_products = [
        2.0 * (d_covariance.x_axis.x * nu + d_covariance.x_axis.y * nv),
        2.0 * (d_covariance.x_axis.y * nu + d_covariance.y_axis.y * nv),
    ];
    let rows = projected.rows;
    let d_axes = [0, 1, 2].map(|k| d_products[0][k] * rows[0] + d_products[1][k] * rows[1]);
    let scale = DVec3::from([0, 1, 2].map(|k| projected.axes[k].dot(d_axes[k])));
    let d = DMat3::from_cols(
        gaussian.scale.x * d_axes[0],
        gaussian.scale.y * d_axes[1],
        gaussian.scale.z * d_axes[2],
    );
    let quat = quat_gradient(gaussian.quat, &d);

    let d_rows = [0, 1]
        .map(|i| (0..3).map(|k| d_products[i][k] * gaussian.scale[k] * projected.axes[k]).sum::<DVec3>());
    let mean = mean_gradient(projection, &projected, d_rows, v.center);
    GaussianGradient { mean, opacity: d_opacity, scale, quat, color: v.color }
}

/// By the quaternion as given, from the gradient by the rotation matrix.
fn quat_gradient(quat: [f64; 4], d: &DMat3) -> [f64; 4] {
    let norm = quat.iter().map(|v| v * v).sum::<f64>().sqrt();
    let unit = quat.map(|v| v / norm);
    let [w, x, y, z] = unit;
    let at = |row: usize, col: usize| d.col(col)[row];
    let by_unit = [
        z * (at(1, 0) - at(0, 1)) + y * (at(0, 2) - at(2, 0)) + x * (at(2, 1) - at(1, 2)),
        y * (at(0, 1) + at(1, 0)) + z * (at(0, 2) + at(2, 0)) + w * (at(2, 1) - at(1, 2))
            - 2.0 * x * (at(1, 1) + at(2, 2)),
        x * (at(0, 1) + at(1, 0)) + w * (at(0, 2) - at(2, 0)) + z * (at(1, 2) + at(2, 1))
            - 2.0 * y * (at(0, 0) + at(2, 2)),
        w * (at(1, 0) - at(0, 1)) + x * (at(0, 2) + at(2, 0)) + y * (at(1, 2) + at(2, 1))
            - 2.0 * z * (at(0, 0) + at(1, 1)),
    ]
    .map(|v| 2.0 * v);
    let along: f64 = unit.iter().zip(&by_unit).map(|(q, v)| q * v).sum();
    [0, 1, 2, 3].map(|i| (by_unit[i] - unit[i] * along) / norm)
}

/// By the world position, from the gradients by the Jacobian's rows in world axes and by the projected center.
fn mean_gradient(
    projection: &Projection,
    projected: &ProjectedCovariance,
    d_rows: [DVec3; 2],
    d_center: DVec2,
) -> DVec3 {
    let view = projection.rotation;
    let position = projected.position;
    let mut d_position = DVec3::ZERO;
    for i in 0..2 {
        let (along, depth) = (d_rows[i].dot(view.row(i)), d_rows[i].dot(view.row(2)));
        let per_depth = projection.focal[i] / (position.z * position.z);
        // A clamped slope does not depend on the position, and depth then enters once instead of twice.
        let free = projected.slope[i] == position[i] / position.z;
        d_position[i] += projection.focal[i] / position.z * d_center[i];
        if free {
            d_position[i] -= per_depth * depth;
        }
        let share = if free { 2.0 } else { 1.0 };
        d_position.z += per_depth * (share * projected.slope[i] * depth - along - position[i] * d_center[i]);
    }
    view.transpose() * d_position
}
