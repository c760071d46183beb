//! From the networks' outputs to Gaussians and back (METHOD.md §2.3).

use glam::DVec3;

use super::{Gaussian, GaussianGradient, LIMIT};
use crate::model::Shape;

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

fn three(values: &[f64], first: usize) -> DVec3 {
    DVec3::from_slice(&values[first..first + 3])
}

/// Scale of the offsets, and base size of the Gaussians.
fn scalings(shape: Shape, row: &[f64]) -> (DVec3, DVec3) {
    let column = shape.scaling_column();
    (three(row, column).map(f64::exp), three(row, column + 3).map(f64::exp))
}

fn offset(shape: Shape, row: &[f64], k: usize) -> DVec3 {
    three(row, shape.offset_column() + 3 * k)
}

/// Where the seven covariance values and the three colour values of offset `k` begin in the output column.
fn outputs_of(shape: Shape, k: usize) -> (usize, usize) {
    (shape.offsets + 7 * k, 8 * shape.offsets + 3 * k)
}

/// The K Gaussians of one anchor; none where the opacity is not positive or its output not finite, the mask is off, or position or
/// size is not finite.
#[must_use]
pub fn spawn_gaussians(
    position: DVec3,
    shape: Shape,
    row: &[f64],
    mask: u32,
    outputs: &[f64],
) -> Vec<Option<Gaussian>> {
    let (reach, size) = scalings(shape, row);
    (0..shape.offsets)
        .map(|k| {
            let (covariance, color) = outputs_of(shape, k);
            let opacity = outputs[k].tanh();
            let gaussian = Gaussian {
                mean: position + offset(shape, row, k) * reach,
                opacity,
                scale: size * three(outputs, covariance).map(logistic),
                quat: [3, 4, 5, 6].map(|i| outputs[covariance + i]),
                color: three(outputs, color).map(logistic),
            };
            let finite =
                gaussian.mean.abs().cmplt(DVec3::splat(LIMIT)).all() && size.element_product() < LIMIT;
            ((mask >> k) & 1 == 1 && outputs[k].is_finite() && opacity > 0.0 && finite).then_some(gaussian)
        })
        .collect()
}

/// The offsets of one anchor that a view can show: bit k is set if offset k makes a Gaussian whose opacity reaches a pixel
/// (METHOD.md §3.2).
#[must_use]
pub fn visible_offsets(position: DVec3, shape: Shape, row: &[f64], mask: u32, outputs: &[f64]) -> u32 {
    const MIN_OPACITY: f64 = 1.0 / 255.0;
    spawn_gaussians(position, shape, row, mask, outputs)
        .iter()
        .enumerate()
        .filter(|(_, gaussian)| gaussian.is_some_and(|gaussian| gaussian.opacity >= MIN_OPACITY))
        .fold(0, |shown, (k, _)| shown | 1 << k)
}

/// Candidate Gaussians, Gaussians, and visible anchors.
#[must_use]
pub fn count_gaussians(shape: Shape, list: &[u32], gaussians: &[Option<Gaussian>]) -> [u32; 3] {
    [list.len() * shape.offsets, gaussians.iter().flatten().count(), list.len()].map(|count| count as u32)
}

/// The volume regulariser: the mean product of the scales over the Gaussians (METHOD.md §2.4).
#[must_use]
pub fn volume(gaussians: &[Option<Gaussian>]) -> f64 {
    let count = gaussians.iter().flatten().count().max(1);
    gaussians.iter().flatten().map(|gaussian| gaussian.scale.element_product()).sum::<f64>() / count as f64
}

/// The gradient by one anchor's output column, from those by its Gaussians; those by its scalings and offsets are written
/// into `d_row`. `volume_weight` is the weight of a Gaussian's product of scales.
#[must_use]
pub fn spawn_gradient(
    shape: Shape,
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
