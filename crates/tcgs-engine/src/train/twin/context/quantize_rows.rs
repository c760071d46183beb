//! Quantized rows.

use super::quantizer::{Quantizer, group, widths};
use crate::{model::ModelShape, train::context::Quantization};

/// One anchor's rendered row. `steps` are the anchor's own.
#[must_use]
pub fn quantize_rows(
    shape: ModelShape,
    by: &Quantization,
    anchor: u32,
    row: &[f64],
    mask: u32,
    steps: [f64; 3],
) -> Vec<f64> {
    let (widths, quantizer) = (widths(by, steps), Quantizer { by, anchor });
    let columns = row.iter().enumerate();
    columns
        .map(|(column, value)| match group(shape, column, mask) {
            None => *value,
            Some(1) => quantizer.quantize_scaling(column, value.exp(), widths[1]).value.ln(),
            Some(group) => quantizer.quantize(column, *value, widths[group]).value,
        })
        .collect()
}
