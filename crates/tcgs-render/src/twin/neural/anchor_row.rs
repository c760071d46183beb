//! The scalings and offsets in the row of an anchor.

use glam::DVec3;

use crate::model::ModelShape;

pub(super) fn three(values: &[f64], first: usize) -> DVec3 {
    DVec3::from_slice(&values[first..first + 3])
}

/// Scale of the offsets, and base size of the Gaussians.
pub(super) fn scalings(shape: ModelShape, row: &[f64]) -> (DVec3, DVec3) {
    let column = shape.scaling_column();
    (three(row, column).map(f64::exp), three(row, column + 3).map(f64::exp))
}

pub(super) fn offset(shape: ModelShape, row: &[f64], k: usize) -> DVec3 {
    three(row, shape.offset_column() + 3 * k)
}
