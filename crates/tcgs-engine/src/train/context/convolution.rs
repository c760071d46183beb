//! The layers between planes and latents on the device, over the three planes at once.

use std::sync::Arc;

use super::layout::ConvSpec;
use crate::gpu::{Buffer, GpuError, Kernel, Plan, Recorder, kernel_source, planned};

/// Marks a layer without a bias.
const NO_BIAS: u32 = u32::MAX;

/// A tensor inside a buffer.
#[derive(Debug, Clone)]
pub(super) struct Tensor {
    pub(super) buffer: Buffer<f32>,
    pub(super) first: usize,
}

impl Tensor {
    pub(super) fn plan(label: &'static str, values: usize) -> Plan<'static, Self> {
        Plan::buffer(label, values).map(|buffer| Self { buffer, first: 0 })
    }

    pub(super) fn at(buffer: &Buffer<f32>, first: usize) -> Self {
        Self { buffer: buffer.clone(), first }
    }
}

/// What happens to a layer's result before it is stored.
#[derive(Debug, Clone, Copy)]
pub(super) enum Epilogue<'a> {
    /// Nothing.
    Linear,
    /// Negative values become zero.
    Relu,
    /// Zero where this tensor of the output's shape is not positive: the gradient before a ReLU.
    Gate(&'a Tensor),
    /// Added to the stored value.
    Add,
}

/// The direction of a layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Direction {
    /// From fine to coarse.
    Down,
    /// From coarse to fine.
    Up,
}

/// A layer with the parameters that it uses.
#[derive(Debug, Clone, Copy)]
pub(super) struct ConvLayer<'a> {
    pub(super) direction: Direction,
    pub(super) spec: &'a ConvSpec,
    pub(super) parameters: &'a Buffer<f32>,
}

/// The kernels.
#[derive(Debug)]
pub(super) struct Convolutions {
    conv_down: Arc<Kernel>,
    conv_up: Arc<Kernel>,
    conv_weight_gradient: Arc<Kernel>,
}

impl Convolutions {
    pub(super) fn plan() -> Plan<'static, Self> {
        planned!(Self {
            conv_down: Plan::kernel(kernel_source!("conv_down"), &[]),
            conv_up: Plan::kernel(kernel_source!("conv_up"), &[]),
            conv_weight_gradient: Plan::kernel(kernel_source!("conv_weight_gradient"), &[]),
        })
    }

    /// Records a layer.
    pub(super) fn forward(
        &self,
        recorder: &mut Recorder<'_>,
        layer: ConvLayer<'_>,
        source: &Tensor,
        result: &Tensor,
        epilogue: Epilogue<'_>,
    ) -> Result<(), GpuError> {
        self.record(recorder, layer, Some(layer.spec.bias), source, result, epilogue)
    }

    /// Records the gradient of a layer by its input: the layer in the other direction, without a bias.
    pub(super) fn input_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        layer: ConvLayer<'_>,
        d_result: &Tensor,
        d_source: &Tensor,
        epilogue: Epilogue<'_>,
    ) -> Result<(), GpuError> {
        let direction = match layer.direction {
            Direction::Down => Direction::Up,
            Direction::Up => Direction::Down,
        };
        self.record(recorder, ConvLayer { direction, ..layer }, None, d_result, d_source, epilogue)
    }

    fn record(
        &self,
        recorder: &mut Recorder<'_>,
        layer: ConvLayer<'_>,
        bias: Option<usize>,
        source: &Tensor,
        result: &Tensor,
        epilogue: Epilogue<'_>,
    ) -> Result<(), GpuError> {
        let ConvLayer { direction, spec, parameters } = layer;
        let (kernel, results) = match direction {
            Direction::Down => (&self.conv_down, spec.coarse_values()),
            Direction::Up => (&self.conv_up, spec.fine_values()),
        };
        // Without a gate any buffer other than the result can be bound.
        let (epilogue, gate) = match epilogue {
            Epilogue::Linear => (0, source),
            Epilogue::Relu => (1, source),
            Epilogue::Gate(gate) => (2, gate),
            Epilogue::Add => (3, source),
        };
        let uniform = recorder.uniform(&[
            [spec.fine as u32, spec.coarse as u32, spec.edge as u32, 0],
            [
                spec.weights as u32,
                bias.map_or(NO_BIAS, |bias| bias as u32),
                source.first as u32,
                result.first as u32,
            ],
            [epilogue, gate.first as u32, 0, 0],
        ])?;
        recorder.dispatch(
            kernel,
            &[&uniform, parameters, &source.buffer, &gate.buffer, &result.buffer],
            results.div_ceil(64) as u32,
        );
        Ok(())
    }

    /// Records the gradient by weights and bias of a layer in `direction`, at their places in `gradients`.
    pub(super) fn weight_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        direction: Direction,
        spec: &ConvSpec,
        source: &Tensor,
        d_result: &Tensor,
        gradients: &Buffer<f32>,
    ) -> Result<(), GpuError> {
        let (fine, coarse, biases) = match direction {
            Direction::Down => (source, d_result, spec.coarse),
            Direction::Up => (d_result, source, spec.fine),
        };
        let uniform = recorder.uniform(&[
            [spec.fine as u32, spec.coarse as u32, spec.edge as u32, u32::from(direction == Direction::Up)],
            [fine.first as u32, coarse.first as u32, spec.weights as u32, spec.bias as u32],
        ])?;
        recorder.dispatch(
            &self.conv_weight_gradient,
            &[&uniform, &fine.buffer, &coarse.buffer, gradients],
            (spec.weight_count() + biases).div_ceil(64) as u32,
        );
        Ok(())
    }
}
