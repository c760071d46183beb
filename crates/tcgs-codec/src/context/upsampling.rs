//! Up-sampling layers of integers: each doubles the edge of a plane by a transposed 3 x 3 convolution of stride 2.
//!
//! An output has at most four taps of each input channel, so the proof of `dense` covers it.

use rayon::prelude::*;

use super::dense::{MAX_ACTIVATION, dot, padded, quantize_bias, quantize_row, shifted};
use crate::domain::UpLayer;

/// Weights of up-sampling layers have eight bits: they are few.
pub(super) const MAX_WEIGHT: i32 = 127;

/// An up-sampling layer of integers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct IntegerUpLayer {
    pub(super) inputs: usize,
    /// Right shift of each output.
    pub(super) shifts: Vec<u8>,
    /// `[inputs][outputs][3][3]`.
    pub(super) weights: Vec<i16>,
    /// In 2^-8, of each output.
    pub(super) bias: Vec<i32>,
}

impl IntegerUpLayer {
    pub(super) fn quantize(layer: &UpLayer) -> Self {
        let outputs = layer.outputs;
        let mut weights = vec![0; layer.weights.len()];
        let mut shifts = Vec::with_capacity(outputs);
        for output in 0..outputs {
            let places: Vec<usize> = (0..layer.inputs)
                .flat_map(|input| (0..9).map(move |tap| (input * outputs + output) * 9 + tap))
                .collect();
            let row: Vec<f32> = places.iter().map(|place| layer.weights[*place]).collect();
            let (shift, integers) = quantize_row(&row, MAX_WEIGHT);
            shifts.push(shift);
            places.iter().zip(integers).for_each(|(place, integer)| weights[*place] = integer);
        }
        let bias = layer.bias.iter().copied().map(quantize_bias).collect();
        Self { inputs: layer.inputs, shifts, weights, bias }
    }

    pub(super) fn as_floats(&self) -> UpLayer {
        let outputs = self.bias.len();
        let scale = |place: usize| 1.0 / (1_u32 << self.shifts[place / 9 % outputs]) as f32;
        UpLayer {
            inputs: self.inputs,
            outputs,
            weights: self.weights.iter().enumerate().map(|(place, w)| f32::from(*w) * scale(place)).collect(),
            bias: self.bias.iter().map(|bias| *bias as f32 / 256.0).collect(),
        }
    }
}

/// A layer's weights by what an output place needs: an even column has one tap, an odd one two, and so have rows.
pub(super) struct Taps<'a> {
    layer: &'a IntegerUpLayer,
    /// For each parity of row and column, padded rows `[outputs][taps][inputs]`.
    rows: [Vec<i16>; 4],
}

/// Offset of the input from the halved output place, and tap, for even and odd places.
const ALONG: [&[(usize, usize)]; 2] = [&[(0, 1)], &[(1, 0), (0, 2)]];

impl<'a> Taps<'a> {
    pub(super) fn new(layer: &'a IntegerUpLayer) -> Self {
        let (inputs, outputs) = (layer.inputs, layer.bias.len());
        let rows = std::array::from_fn(|parity| {
            let (vertical, horizontal) = (ALONG[parity / 2], ALONG[parity % 2]);
            let stride = padded(vertical.len() * horizontal.len() * inputs);
            let mut rows = Vec::with_capacity(outputs * stride);
            for output in 0..outputs {
                for (_, v) in vertical {
                    for (_, u) in horizontal {
                        let tap = 3 * v + u;
                        rows.extend(
                            (0..inputs).map(|input| layer.weights[(input * outputs + output) * 9 + tap]),
                        );
                    }
                }
                rows.resize((output + 1) * stride, 0);
            }
            rows
        });
        Self { layer, rows }
    }

    /// One plane `[edge][edge][inputs]` made `[2 edge][2 edge][outputs]`.
    pub(super) fn apply(&self, plane: &[i16], edge: usize, low: i32) -> Vec<i16> {
        let (inputs, outputs) = (self.layer.inputs, self.layer.bias.len());
        let mut result = vec![0; 4 * edge * edge * outputs];
        result.par_chunks_mut(2 * edge * outputs).enumerate().for_each(|(row, line)| {
            let mut gathered = Vec::new();
            for (column, place) in line.chunks_mut(outputs).enumerate() {
                let parity = row % 2 * 2 + column % 2;
                gathered.clear();
                for (down, _) in ALONG[row % 2] {
                    for (right, _) in ALONG[column % 2] {
                        let (y, x) = (row / 2 + down, column / 2 + right);
                        if y < edge && x < edge {
                            let start = (y * edge + x) * inputs;
                            gathered.extend_from_slice(&plane[start..start + inputs]);
                        } else {
                            gathered.resize(gathered.len() + inputs, 0);
                        }
                    }
                }
                let stride = padded(gathered.len());
                gathered.resize(stride, 0);
                for (output, value) in place.iter_mut().enumerate() {
                    let sum = dot(&self.rows[parity][output * stride..(output + 1) * stride], &gathered);
                    let sum = shifted(sum, self.layer.shifts[output], self.layer.bias[output]);
                    *value = sum.clamp(low, MAX_ACTIVATION) as i16;
                }
            }
        });
        result
    }
}
