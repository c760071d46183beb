//! From the gradients by quantized rows to those by rows and steps.

use std::f64::consts::LN_2;

use super::quantizer::{Quantizer, group, through_floor, widths};
use crate::{model::ModelShape, train::context::Quantization};

/// One anchor's gradients by its row and by the base-2 logarithms of its steps, from those by its rendered row.
#[must_use]
pub fn quantize_gradient(
    shape: ModelShape,
    by: &Quantization,
    anchor: u32,
    row: &[f64],
    mask: u32,
    steps: [f64; 3],
    d_rendered: &[f64],
) -> (Vec<f64>, [f64; 3]) {
    let (widths, quantizer) = (widths(by, steps), Quantizer { by, anchor });
    let (mut d_row, mut d_log_quant_steps) = (d_rendered.to_vec(), [0.0; 3]);
    for (column, value) in row.iter().enumerate() {
        let d = d_rendered[column];
        match group(shape, column, mask) {
            None => {}
            Some(1) => {
                let scaling = value.exp();
                let quantized = quantizer.quantize_scaling(column, scaling, widths[1]);
                let d = d / quantized.value;
                d_log_quant_steps[1] += d * quantized.by_width * widths[1] * LN_2;
                d_row[column] = through_floor(scaling, widths[1], d) * scaling;
            }
            Some(group) => {
                let by_width = quantizer.quantize(column, *value, widths[group]).by_width;
                d_log_quant_steps[group] += d * by_width * widths[group] * LN_2;
            }
        }
    }
    (d_row, d_log_quant_steps)
}
