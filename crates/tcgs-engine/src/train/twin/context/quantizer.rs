//! A value of an anchor as it is rendered.

use crate::{
    model::ModelShape,
    train::context::{Quantization, QuantizationPhase, pcg_hash},
};

/// Uniform in (-1/2, 1/2); the kernel has the same bits.
#[must_use]
pub fn noise(key: u32, anchor: u32, column: u32) -> f64 {
    let stream = pcg_hash(pcg_hash(anchor) ^ key);
    (f64::from(pcg_hash(stream.wrapping_add(column)) >> 9) + 0.5) / f64::from(1 << 23) - 0.5
}

/// A value as it is rendered, with its derivative by the step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Quantized {
    pub(super) value: f64,
    pub(super) by_width: f64,
}

/// One anchor's way of quantizing.
#[derive(Debug, Clone, Copy)]
pub(super) struct Quantizer<'a> {
    pub(super) by: &'a Quantization,
    pub(super) anchor: u32,
}

impl Quantizer<'_> {
    pub(super) fn quantize(self, column: usize, value: f64, width: f64) -> Quantized {
        if self.by.phase == QuantizationPhase::Rounded {
            let nearest = (value / width).round_ties_even();
            return Quantized { value: nearest * width, by_width: nearest - value / width };
        }
        let noise = noise(self.by.key, self.anchor, column as u32);
        Quantized { value: value + noise * width, by_width: noise }
    }

    /// As it is, not as a logarithm; below one step it counts as one step.
    pub(super) fn quantize_scaling(self, column: usize, scaling: f64, width: f64) -> Quantized {
        let Quantized { value, by_width } = self.quantize(column, scaling.max(width), width);
        Quantized { value, by_width: by_width + f64::from(u8::from(scaling < width)) }
    }
}

/// What of a gradient by a quantized scaling reaches the scaling.
pub(super) fn through_floor(scaling: f64, width: f64, gradient: f64) -> f64 {
    if scaling < width { gradient.min(0.0) } else { gradient }
}

pub(super) fn widths(by: &Quantization, steps: [f64; 3]) -> [f64; 3] {
    if by.phase == QuantizationPhase::FixedNoise { by.base_quant_steps.map(f64::from) } else { steps }
}

/// The group of a column, or none if it belongs to a masked offset.
pub(super) fn group(shape: ModelShape, column: usize, mask: u32) -> Option<usize> {
    if column < shape.scaling_column() {
        Some(0)
    } else if column < shape.offset_column() {
        Some(1)
    } else {
        let offset = (column - shape.offset_column()) / 3;
        (mask >> offset & 1 == 1).then_some(2)
    }
}
