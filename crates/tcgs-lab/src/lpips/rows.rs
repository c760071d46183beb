//! Rows of a feature map, and the convolution and pooling that lead from rows to rows.
//!
//! A map is stored row by row with the channels of a position side by side, so that a strip's rows are one slice, and a
//! window's row is one copy.

use std::ops::Range;

use ndarray::{Array2, ArrayView2, ArrayViewMut2, linalg::general_mat_mul};

use super::layout::Window;

/// Output positions that one matrix product covers at least: enough to be worth packing the kernel for.
const BLOCK: usize = 256;

/// The rows `range` of a map of `height` rows.
#[derive(Debug, Clone)]
pub(super) struct Rows {
    pub(super) range: Range<usize>,
    pub(super) height: usize,
    pub(super) width: usize,
    pub(super) channels: usize,
    /// `[row][position][channel]`.
    pub(super) values: Vec<f32>,
}

impl Rows {
    /// All rows of a map.
    pub(super) fn whole(width: usize, height: usize, channels: usize, values: Vec<f32>) -> Self {
        Self { range: 0..height, height, width, channels, values }
    }

    /// The values of row `y` of the map, which is among these rows.
    pub(super) fn row(&self, y: usize) -> &[f32] {
        let length = self.width * self.channels;
        &self.values[(y - self.range.start) * length..][..length]
    }
}

/// A convolution with its weights, and the ReLU after it.
#[derive(Debug)]
pub(super) struct Convolution {
    pub(super) window: Window,
    /// `[window row, window column, input channel][output channel]`.
    pub(super) kernel: Array2<f32>,
    pub(super) bias: Vec<f32>,
}

impl Convolution {
    /// The rows `range` of the output, from a map whose rows that they look at are among `input`.
    pub(super) fn rows(&self, input: &Rows, range: Range<usize>) -> Rows {
        let (width, outputs) = (self.window.outputs(input.width), self.bias.len());
        let length = width * outputs;
        let mut values = self.bias.repeat(range.len() * width);
        let mut patches = Vec::new();
        let rows_at_once = BLOCK.div_ceil(width);
        for (block, ys) in values.chunks_mut(rows_at_once * length).zip(chunks(&range, rows_at_once)) {
            let positions = ys.len() * width;
            patches.clear();
            patches.resize(positions * self.kernel.nrows(), 0.0);
            self.unfold(input, ys, &mut patches);
            let patches = ArrayView2::from_shape((positions, self.kernel.nrows()), &patches)
                .expect("resized to this shape");
            let mut block =
                ArrayViewMut2::from_shape((positions, outputs), block).expect("whole rows of the output");
            general_mat_mul(1.0, &patches, &self.kernel, 1.0, &mut block);
        }
        // Not `max`, which would hide a NaN.
        values.iter_mut().filter(|value| **value < 0.0).for_each(|value| *value = 0.0);
        Rows { range, height: self.window.outputs(input.height), width, channels: outputs, values }
    }

    /// Writes what each output position of the rows `ys` looks at into its row of `patches`, which is zero before.
    fn unfold(&self, input: &Rows, ys: Range<usize>, patches: &mut [f32]) {
        let Window { size, stride, padding } = self.window;
        let (width, channels) = (self.window.outputs(input.width), input.channels);
        for (patch, (y, x)) in patches
            .chunks_exact_mut(self.kernel.nrows())
            .zip(ys.flat_map(|y| (0..width).map(move |x| (y, x))))
        {
            let sources = self.window.sources(&(x..x + 1), input.width);
            let first = sources.start + padding - x * stride;
            for (row, part) in patch.chunks_exact_mut(size * channels).enumerate() {
                let Some(source) = (y * stride + row).checked_sub(padding).filter(|y| *y < input.height)
                else {
                    continue;
                };
                let seen = &input.row(source)[sources.start * channels..sources.end * channels];
                part[first * channels..][..seen.len()].copy_from_slice(seen);
            }
        }
    }
}

/// The rows `range` of the maxima over the windows of a map whose rows that they look at are among `input`.
pub(super) fn pool(window: Window, input: &Rows, range: Range<usize>) -> Rows {
    let (width, channels) = (window.outputs(input.width), input.channels);
    let mut values = vec![f32::NEG_INFINITY; range.len() * width * channels];
    for (y, output) in range.clone().zip(values.chunks_exact_mut(width * channels)) {
        for source in window.sources(&(y..y + 1), input.height) {
            let row = input.row(source);
            for (x, maxima) in output.chunks_exact_mut(channels).enumerate() {
                for position in window.sources(&(x..x + 1), input.width) {
                    let seen = &row[position * channels..][..channels];
                    maxima.iter_mut().zip(seen).for_each(|(maximum, value)| *maximum = maximum.max(*value));
                }
            }
        }
    }
    Rows { range, height: window.outputs(input.height), width, channels, values }
}

/// `range` in pieces of `length`, the last one perhaps shorter.
pub(super) fn chunks(range: &Range<usize>, length: usize) -> impl Iterator<Item = Range<usize>> + use<> {
    let end = range.end;
    range.clone().step_by(length).map(move |start| start..(start + length).min(end))
}
