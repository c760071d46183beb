//! The rate of an attribute group of one anchor.

use std::f64::consts::LN_2;

use super::{
    quantizer::{Quantizer, through_floor},
    refresh_quant_steps,
    step_octaves::{SPACING, octaves_of, spacings},
    symbol_bits,
};
use crate::{
    domain::{AttributeGroup, context_model::STEP_OCTAVES},
    train::context::{Quantization, QuantizationPhase},
};

/// The coded standard deviations: the finest in octaves of steps, and the last of them.
const FINEST: f64 = -3.5;
const LAST: i64 = 63;

/// Bits of an escape, without twice the logarithm of its distance.
const ESCAPE_BITS: f64 = 26.0;

/// A value's derivatives, counted in steps and octaves, go no further.
const MAX_DERIVATIVE: f64 = 1e4;

/// The bits of a group of one anchor, and the gradients.
#[derive(Debug, Clone, PartialEq)]
pub struct RateGradients {
    /// Bits a channel under the distribution, which the gradients are of.
    pub bits: Vec<f64>,
    /// Bits a channel that a file takes, where values far out are escapes.
    pub stored: Vec<f64>,
    /// `weight` times the bits' derivatives by the network's outputs; the adjustment's includes what rendering says.
    pub outputs: Vec<f64>,
    /// `weight` times the bits' derivatives by the group's part of the row.
    pub row: Vec<f64>,
}

/// An attribute group of one anchor, and what its network predicts.
#[derive(Debug, Clone, Copy)]
pub struct RateInput<'a> {
    /// The anchor's index.
    pub anchor: u32,
    /// The group.
    pub group: AttributeGroup,
    /// First column of the group in the anchor's row.
    pub first: usize,
    /// The group's part of the anchor's row.
    pub row: &'a [f64],
    /// The anchor's offset mask.
    pub mask: u32,
    /// The network's outputs: each channel's mean in base steps, each channel's base-2 logarithm of the standard deviation, the
    /// step adjustment.
    pub outputs: &'a [f64],
    /// The rendering loss's gradient by the logarithm of the quantization step, scaled up to all anchors.
    pub d_log_step: f64,
    /// Weight of a bit in the loss.
    pub weight: f64,
}

/// The bits of an attribute group of one anchor, and their gradients.
#[must_use]
pub fn rate(by: &Quantization, input: &RateInput<'_>) -> RateGradients {
    let RateInput { anchor, group, first, row, mask, outputs, d_log_step, weight } = *input;
    let channels = row.len();
    let wanted = outputs[2 * channels];
    let rounds = by.phase == QuantizationPhase::Rounded;
    let (octaves, index) = octaves_of(by.phase, wanted);
    let (in_base, step) = (octaves.exp2(), refresh_quant_steps(by, group, wanted));
    let quantizer = Quantizer { by, anchor };
    let mut found = RateGradients {
        bits: vec![0.0; channels],
        stored: vec![0.0; channels],
        outputs: vec![0.0; 2 * channels + 1],
        row: vec![0.0; channels],
    };
    let mut by_octaves = 0.0;
    for channel in 0..channels {
        let is_offset = group == AttributeGroup::Offsets;
        if is_offset && mask >> (channel / 3) & 1 == 0 {
            continue;
        }
        let is_scaling = group == AttributeGroup::Scalings;
        let value = if is_scaling { row[channel].exp() } else { row[channel] };
        let quantized = if is_scaling {
            quantizer.quantize_scaling(first + channel, value, step)
        } else {
            quantizer.quantize(first + channel, value, step)
        };
        let (symbol, mean) = (quantized.value / step, outputs[channel] / in_base);
        let scale = outputs[channels + channel];
        let unbounded = scale - octaves;
        let bounded = unbounded.clamp(FINEST, FINEST + LAST as f64 * SPACING);
        let (coded, center) = if rounds {
            let scale_index = (spacings(scale) + 16 - index).clamp(0, LAST);
            (FINEST + SPACING * scale_index as f64, (16.0 * mean + 0.5).floor() / 16.0)
        } else {
            (bounded, mean)
        };
        let cost = symbol_bits(symbol, center, coded.exp2(), 1.0);
        found.bits[channel] = cost.bits;
        found.stored[channel] = cost.bits.min(ESCAPE_BITS + 2.0 * (1.0 + (symbol - center).abs()).log2());
        let by_value = cost.by_value.clamp(-MAX_DERIVATIVE, MAX_DERIVATIVE);
        let by_coded = cost.by_log_deviation.clamp(-MAX_DERIVATIVE, MAX_DERIVATIVE);
        let mut by_adjustment = -LN_2 * by_value * (symbol - quantized.by_width - center);
        let by_scale = if bounded == unbounded {
            by_adjustment -= by_coded;
            by_coded
        } else if bounded > unbounded {
            by_coded.min(0.0)
        } else {
            by_coded.max(0.0)
        };
        by_octaves += by_adjustment.clamp(-MAX_DERIVATIVE, MAX_DERIVATIVE);
        found.outputs[channel] = -weight * by_value / in_base;
        found.outputs[channels + channel] = weight * by_scale;
        let by_row = by_value / step;
        let by_row = if is_scaling { through_floor(value, step, by_row) * value } else { by_row };
        found.row[channel] = weight * by_row;
    }
    if wanted.abs() <= f64::from(STEP_OCTAVES) {
        found.outputs[2 * channels] = weight * by_octaves + d_log_step;
    }
    found
}
