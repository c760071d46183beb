//! Weights rounded to the form in which a file holds them, so that training sees what a decoder will have. Gradients pass as
//! if nothing were rounded.

use std::sync::Arc;

use super::layout::ContextLayout;
use crate::gpu::{Buffer, Context, GpuError, Kernel, Recorder, kernel_source};

/// Rows of weights that are rounded alike.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Rows {
    rows: usize,
    first: usize,
    /// From a row to the next.
    step: usize,
    /// A row's weights lie in this many blocks,
    blocks: usize,
    /// each so far from the last,
    block_step: usize,
    /// of so many.
    block: usize,
}

/// Every row of weights that a file holds: those of one output of a layer.
fn stored_rows(layout: &ContextLayout) -> impl Iterator<Item = Rows> {
    let dense = std::iter::once(&layout.hidden).chain(&layout.heads).map(|layer| Rows {
        rows: layer.outputs,
        first: layer.weights,
        step: 1,
        blocks: layer.inputs,
        block_step: layer.outputs,
        block: 1,
    });
    let up = layout.up.iter().map(|layer| Rows {
        rows: layer.fine,
        first: layer.weights,
        step: 9,
        blocks: layer.coarse,
        block_step: 9 * layer.fine,
        block: 9,
    });
    dense.chain(up)
}

/// The kernel and the rounded copy.
#[derive(Debug)]
pub(super) struct RoundedWeights {
    round_weights: Arc<Kernel>,
    values: Buffer<f32>,
}

impl RoundedWeights {
    pub(super) fn new(context: &Context, layout: &ContextLayout) -> Result<Self, GpuError> {
        Ok(Self {
            round_weights: context.kernel(kernel_source!("round_weights"), &[])?,
            values: context.buffer("rounded context parameters", layout.parameters)?,
        })
    }

    /// The copy of the last [`Self::record`].
    pub(super) fn values(&self) -> &Buffer<f32> {
        &self.values
    }

    /// Records a copy of the parameters with weights as integers of at most `levels` over a power of two for each row.
    pub(super) fn record(
        &self,
        recorder: &mut Recorder<'_>,
        layout: &ContextLayout,
        parameters: &Buffer<f32>,
        levels: u8,
    ) -> Result<(), GpuError> {
        recorder.copy(parameters, 0, &self.values, 0, layout.parameters);
        for rows in stored_rows(layout) {
            let uniform = recorder.uniform(&[
                [rows.rows as u32, rows.first as u32, rows.step as u32, 0],
                [rows.blocks as u32, rows.block_step as u32, rows.block as u32, u32::from(levels)],
            ])?;
            recorder.dispatch(
                &self.round_weights,
                &[uniform.as_ref(), parameters.as_ref(), self.values.as_ref()],
                rows.rows.div_ceil(64) as u32,
            );
        }
        Ok(())
    }
}
