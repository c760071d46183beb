//! Weights rounded to the values that a file stores, so that training uses what a decoder will have, with straight-through
//! gradients.
//!
//! A weight is an integer over a power of two, the largest for each row of weights that the integer's width allows, at most
//! 2^15: what the codec makes of the same weights. Biases and activations, which it keeps to 1/256, stay as they are.

use std::sync::Arc;

use super::layout::ContextLayout;
use crate::gpu::{Buffer, GpuError, Kernel, Plan, Recorder, kernel_source, planned};

/// Largest integer of an up-sampling layer's weights: the codec stores them in eight bits whatever the networks have.
const UP_LEVELS: usize = 127;

/// A row of weights, those of one output of a layer, as `shaders/context/round_weights.wgsl` takes it: where it begins, in how many
/// blocks it lies, how far from each other, of how many weights, and its levels, or 0 for the networks'.
type Row = [u32; 5];

/// Every row of weights that a file holds.
fn stored_rows(layout: &ContextLayout) -> Vec<Row> {
    let mut rows = Vec::new();
    for layer in std::iter::once(&layout.hidden).chain(&layout.heads) {
        let row = |output| [layer.weights + output, layer.inputs, layer.outputs, 1, 0];
        rows.extend((0..layer.outputs).map(row));
    }
    for layer in &layout.up {
        let row = |output| [layer.weights + 9 * output, layer.coarse, 9 * layer.fine, 9, UP_LEVELS];
        rows.extend((0..layer.fine).map(row));
    }
    rows.into_iter().map(|row| row.map(|value| value as u32)).collect()
}

/// The kernel and the rounded copy.
#[derive(Debug)]
pub(super) struct RoundedWeights {
    round_weights: Arc<Kernel>,
    rows: Buffer<Row>,
    values: Buffer<f32>,
}

impl RoundedWeights {
    pub(super) fn plan(layout: &ContextLayout) -> Plan<'static, Self> {
        planned!(Self {
            round_weights: Plan::kernel(kernel_source!("round_weights"), &[]),
            rows: Plan::upload("rows of context weights", stored_rows(layout)),
            values: Plan::buffer("rounded context parameters", layout.parameters),
        })
    }

    /// The copy of the last [`Self::record`].
    pub(super) fn values(&self) -> &Buffer<f32> {
        &self.values
    }

    /// Records a copy of the parameters with rounded weights, the networks' with integers of at most `levels`.
    pub(super) fn record(
        &self,
        recorder: &mut Recorder<'_>,
        parameters: &Buffer<f32>,
        levels: u8,
    ) -> Result<(), GpuError> {
        recorder.copy(parameters, 0, &self.values, 0, parameters.len());
        let uniform = recorder.uniform(&[[self.rows.len() as u32, u32::from(levels), 0, 0]])?;
        recorder.dispatch(
            &self.round_weights,
            &[&uniform, &self.rows, parameters, &self.values],
            self.rows.len().div_ceil(64) as u32,
        );
        Ok(())
    }
}
