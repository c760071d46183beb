//! From the gradients by Gaussians to those by the networks' outputs.

use glam::DVec3;

use super::{
    anchor_row::{offset, scalings, three},
    output_column::{logistic, outputs_of},
};
use crate::{
    model::ModelShape,
    twin::{Gaussian, GaussianGradient},
};

/// The gradient by one anchor's output column, from those by its Gaussians; those by its scalings and offsets are written
/// into `d_row`. `volume_weight` is the weight of a Gaussian's product of scales.
#[must_use]
pub fn spawn_gradient(
    shape: ModelShape,
    row: &[f64],
    outputs: &[f64],
    gaussians: &[Option<Gaussian>],
    d_gaussians: &[GaussianGradient],
    volume_weight: f64,
    d_row: &mut [f64],
) -> Vec<f64> {
    let (reach, size) = scalings(shape, row);
    let mut d_outputs = vec![0.0; outputs.len()];
    let (mut d_reach, mut d_size) = (DVec3::ZERO, DVec3::ZERO);
    for (k, (gaussian, d)) in gaussians.iter().zip(d_gaussians).enumerate() {
        let Some(gaussian) = gaussian else { continue };
        let (covariance, color) = outputs_of(shape, k);
        d_outputs[k] = d.opacity * (1.0 - gaussian.opacity * gaussian.opacity);
        (d.mean * reach).write_to_slice(&mut d_row[shape.offset_column() + 3 * k..]);
        d_reach += d.mean * offset(shape, row, k);

        let part = three(outputs, covariance).map(logistic);
        let scale = gaussian.scale;
        let others = DVec3::new(scale.y * scale.z, scale.x * scale.z, scale.x * scale.y);
        let d_scale = d.scale + volume_weight * others;
        d_size += d_scale * part;
        (d_scale * size * part * (1.0 - part)).write_to_slice(&mut d_outputs[covariance..]);
        d_outputs[covariance + 3..covariance + 7].copy_from_slice(&d.quat);
        (d.color * gaussian.color * (1.0 - gaussian.color)).write_to_slice(&mut d_outputs[color..]);
    }
    (d_reach * reach).write_to_slice(&mut d_row[shape.scaling_column()..]);
    (d_size * size).write_to_slice(&mut d_row[shape.scaling_column() + 3..]);
    d_outputs
}
