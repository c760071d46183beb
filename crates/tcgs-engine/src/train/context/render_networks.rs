//! The render networks as decoded: weights and biases rounded as by the codec, so that the last steps of training render with what a
//! decoder will have.
//!
//! The gradient by the rounded parameters is taken for that by the parameters. Where an adapter's division is not that of
//! IEEE 754 (WGSL allows 2.5 units in the last place), a weight at a tie may come out one level off the codec's.

use std::sync::Arc;

use crate::{
    gpu::{Buffer, GpuError, Kernel, Plan, Recorder, kernel_source, planned},
    model::{LayerSpec, NetworkLayout},
};

/// Largest magnitudes of the integers for weights (8 bits) and for biases.
const LEVELS: u32 = 127;
const BIAS_LEVELS: u32 = 2047;

/// As in `shaders/context/round_rows.wgsl`.
const IS_BIAS: u32 = 1 << 31;

/// Rounded parameters on the device.
#[derive(Debug)]
pub struct RoundedNetworks {
    round_rows: Arc<Kernel>,
    rows: Buffer<[u32; 4]>,
    parameters: Buffer<f32>,
}

impl RoundedNetworks {
    /// Plans the rounded parameters of networks of this layout.
    #[must_use]
    pub fn plan(layout: &NetworkLayout) -> Plan<'static, Self> {
        planned!(Self {
            round_rows: Plan::kernel(kernel_source!("round_rows"), &[]),
            rows: Plan::upload("rows of networks", rows(layout)),
            parameters: Plan::buffer("rounded networks", layout.parameters),
        })
    }

    /// The rounded parameters, laid out as the networks.
    #[must_use]
    pub fn parameters(&self) -> &Buffer<f32> {
        &self.parameters
    }

    /// Records the rounding of `parameters`.
    pub fn record(&self, recorder: &mut Recorder<'_>, parameters: &Buffer<f32>) -> Result<(), GpuError> {
        let shape = recorder.uniform(&[[self.rows.len() as u32, 0, 0, 0]])?;
        recorder.dispatch(
            &self.round_rows,
            &[&shape, &self.rows, parameters, &self.parameters],
            self.rows.len().div_ceil(64) as u32,
        );
        Ok(())
    }
}

/// What shares a scale: every output's weights, and the biases of each layer of each network. First parameter, distance to
/// the next, how many, levels.
fn rows(layout: &NetworkLayout) -> Vec<[u32; 4]> {
    let width = layout.shape.hidden;
    let weights = |layer: &LayerSpec| {
        let LayerSpec { inputs, outputs, weights, .. } = *layer;
        (0..outputs).map(move |row| [weights + row, outputs, inputs].map(|v| v as u32)).collect::<Vec<_>>()
    };
    // The first layers of the three networks are one layer here.
    let hidden = (0..3).map(|network| [layout.hidden.bias + network * width, width]);
    let biases = hidden.chain(layout.heads.iter().map(|head| [head.bias, head.outputs]));
    std::iter::once(&layout.hidden)
        .chain(&layout.heads)
        .flat_map(weights)
        .map(|[first, stride, count]| [first, stride, count, LEVELS])
        .chain(biases.map(|[first, count]| [first as u32, 1, count as u32, IS_BIAS | BIAS_LEVELS]))
        .collect()
}
