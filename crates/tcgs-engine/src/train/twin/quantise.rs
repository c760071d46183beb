//! Quantised rows, their backward pass, and networks as decoded.

use std::f64::consts::LN_2;

use crate::{
    model::Shape,
    train::context::{Quantisation, QuantisationPhase, pcg_hash},
};

/// Uniform in (-1/2, 1/2); the kernel has the same bits.
#[must_use]
pub fn noise(key: u32, anchor: u32, column: u32) -> f64 {
    let stream = pcg_hash(pcg_hash(anchor) ^ key);
    (f64::from(pcg_hash(stream.wrapping_add(column)) >> 9) + 0.5) / f64::from(1 << 23) - 0.5
}

/// A value as it is rendered, with its derivative by the step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Quantised {
    pub(super) value: f64,
    pub(super) by_width: f64,
}

/// One anchor's way of quantising.
#[derive(Debug, Clone, Copy)]
pub(super) struct Quantiser<'a> {
    pub(super) by: &'a Quantisation,
    pub(super) anchor: u32,
}

impl Quantiser<'_> {
    pub(super) fn quantise(self, column: usize, value: f64, width: f64) -> Quantised {
        if self.by.phase == QuantisationPhase::Rounded {
            let nearest = (value / width).round_ties_even();
            return Quantised { value: nearest * width, by_width: nearest - value / width };
        }
        let noise = noise(self.by.key, self.anchor, column as u32);
        Quantised { value: value + noise * width, by_width: noise }
    }

    /// As it is, not as a logarithm; below one step it counts as one step.
    pub(super) fn quantise_scaling(self, column: usize, scaling: f64, width: f64) -> Quantised {
        let Quantised { value, by_width } = self.quantise(column, scaling.max(width), width);
        Quantised { value, by_width: by_width + f64::from(u8::from(scaling < width)) }
    }
}

/// What of a gradient by a quantised scaling reaches the scaling.
pub(super) fn through_floor(scaling: f64, width: f64, gradient: f64) -> f64 {
    if scaling < width { gradient.min(0.0) } else { gradient }
}

fn widths(by: &Quantisation, steps: [f64; 3]) -> [f64; 3] {
    if by.phase == QuantisationPhase::FixedNoise { by.base_quant_steps.map(f64::from) } else { steps }
}

/// The group of a column, or none if it belongs to a masked offset.
fn group(shape: Shape, column: usize, mask: u32) -> Option<usize> {
    if column < shape.scaling_column() {
        Some(0)
    } else if column < shape.offset_column() {
        Some(1)
    } else {
        let offset = (column - shape.offset_column()) / 3;
        (mask >> offset & 1 == 1).then_some(2)
    }
}

/// One anchor's rendered row. `steps` are the anchor's own.
#[must_use]
pub fn quantise_rows(
    shape: Shape,
    by: &Quantisation,
    anchor: u32,
    row: &[f64],
    mask: u32,
    steps: [f64; 3],
) -> Vec<f64> {
    let (widths, quantiser) = (widths(by, steps), Quantiser { by, anchor });
    let columns = row.iter().enumerate();
    columns
        .map(|(column, value)| match group(shape, column, mask) {
            None => *value,
            Some(1) => quantiser.quantise_scaling(column, value.exp(), widths[1]).value.ln(),
            Some(group) => quantiser.quantise(column, *value, widths[group]).value,
        })
        .collect()
}

/// One anchor's gradients by its row and by the base-2 logarithms of its steps, from those by its rendered row.
#[must_use]
pub fn quantise_gradient(
    shape: Shape,
    by: &Quantisation,
    anchor: u32,
    row: &[f64],
    mask: u32,
    steps: [f64; 3],
    d_rendered: &[f64],
) -> (Vec<f64>, [f64; 3]) {
    let (widths, quantiser) = (widths(by, steps), Quantiser { by, anchor });
    let (mut d_row, mut d_log_quant_steps) = (d_rendered.to_vec(), [0.0; 3]);
    for (column, value) in row.iter().enumerate() {
        let d = d_rendered[column];
        match group(shape, column, mask) {
            None => {}
            Some(1) => {
                let scaling = value.exp();
                let quantised = quantiser.quantise_scaling(column, scaling, widths[1]);
                let d = d / quantised.value;
                d_log_quant_steps[1] += d * quantised.by_width * widths[1] * LN_2;
                d_row[column] = through_floor(scaling, widths[1], d) * scaling;
            }
            Some(group) => {
                let by_width = quantiser.quantise(column, *value, widths[group]).by_width;
                d_log_quant_steps[group] += d * by_width * widths[group] * LN_2;
            }
        }
    }
    (d_row, d_log_quant_steps)
}

/// Weights that share a scale as a file gives them back; the same f32 operations as the codec's, which is what they are
/// held to. Biases are finer and their scale is a whole f32.
#[must_use]
pub fn round_rows(values: &[f32], levels: u16, is_bias: bool) -> Vec<f32> {
    let levels = f32::from(levels);
    let exact = values.iter().fold(0.0_f32, |largest, value| largest.max(value.abs())) / levels;
    let upper_half = (exact.to_bits().saturating_add(0xffff) >> 16).min(0x7f7f) << 16;
    let scale = if is_bias { exact } else { f32::from_bits(upper_half) };
    let rounded = |value: &f32| {
        if scale == 0.0 { 0.0 } else { (value / scale).round_ties_even().clamp(-levels, levels) * scale }
    };
    values.iter().map(rounded).collect()
}
