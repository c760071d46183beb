//! From the networks' outputs to Gaussians (METHOD.md §2.3).

use glam::DVec3;

use super::{
    LIMIT,
    anchor_row::{offset, scalings, three},
    output_column::{logistic, outputs_of},
};
use crate::{model::ModelShape, twin::Gaussian};

/// The K Gaussians of one anchor; none where the opacity is not positive or its output not finite, the mask is off, or position or
/// size is not finite.
#[must_use]
pub fn spawn_gaussians(
    position: DVec3,
    shape: ModelShape,
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
