//! The gradient by the features of anchors.

use crate::model::ModelShape;

/// Writes the feature's part of the input gradient into the anchor's row.
pub fn feature_gradient(shape: ModelShape, d_input: &[f64], d_row: &mut [f64]) {
    d_row[..shape.features].copy_from_slice(&d_input[..shape.features]);
}
