//! Where the networks' outputs of an offset are, and their activation.

use crate::model::ModelShape;

pub(super) fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Where the seven covariance values and the three color values of offset `k` begin in the output column.
pub(super) fn outputs_of(shape: ModelShape, k: usize) -> (usize, usize) {
    (shape.offsets + 7 * k, 8 * shape.offsets + 3 * k)
}
