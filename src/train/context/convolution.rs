//! The layers between planes and latents on the device, over the three planes at once.

use std::sync::Arc;

use super::layout::ConvSpec;
use crate::gpu::{Buffer, GpuError, Kernel, Plan, Recorder, kernel_source, planned};

/// A bias that there is not.
const NONE: u32 = u32::MAX;

/// A tensor in a buffer that may hold more.
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

/// How a layer ends.
#[derive(Debug, Clone, Copy)]
pub(super) enum Finish<'a> {
    /// As it is.
    Plain,
    /// What is below zero becomes zero.
    Relu,
    /// Zero where this tensor of the output's shape is not above zero: the gradient before a ReLU.
    Gate(&'a Tensor),
    /// Added to what is there.
    Add,
}

/// Which way a layer goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Way {
    /// From fine to coarse.
    Down,
    /// From coarse to fine.
    Up,
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
    #[expect(clippy::too_many_arguments, reason = "one dispatch's worth of tensors, named at each call")]
    pub(super) fn forward(
        &self,
        recorder: &mut Recorder<'_>,
        way: Way,
        spec: &ConvSpec,
        parameters: &Buffer<f32>,
        source: &Tensor,
        result: &Tensor,
        finish: Finish<'_>,
    ) -> Result<(), GpuError> {
        self.record(recorder, way, spec, Some(spec.bias), parameters, source, result, finish)
    }

    /// Records the gradient of a layer that went `way` by its input: the layer the other way, without a bias.
    #[expect(clippy::too_many_arguments, reason = "one dispatch's worth of tensors, named at each call")]
    pub(super) fn input_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        way: Way,
        spec: &ConvSpec,
        parameters: &Buffer<f32>,
        d_result: &Tensor,
        d_source: &Tensor,
        finish: Finish<'_>,
    ) -> Result<(), GpuError> {
        let back = match way {
            Way::Down => Way::Up,
            Way::Up => Way::Down,
        };
        self.record(recorder, back, spec, None, parameters, d_result, d_source, finish)
    }

    #[expect(clippy::too_many_arguments, reason = "one dispatch's worth of tensors, named at each call")]
    fn record(
        &self,
        recorder: &mut Recorder<'_>,
        way: Way,
        spec: &ConvSpec,
        bias: Option<usize>,
        parameters: &Buffer<f32>,
        source: &Tensor,
        result: &Tensor,
        finish: Finish<'_>,
    ) -> Result<(), GpuError> {
        let (kernel, results) = match way {
            Way::Down => (&self.conv_down, spec.coarse_values()),
            Way::Up => (&self.conv_up, spec.fine_values()),
        };
        // Where there is no gate, any buffer but the result will do.
        let (ending, gate) = match finish {
            Finish::Plain => (0, source),
            Finish::Relu => (1, source),
            Finish::Gate(gate) => (2, gate),
            Finish::Add => (3, source),
        };
        let uniform = recorder.uniform(&[
            [spec.fine as u32, spec.coarse as u32, spec.edge as u32, 0],
            [
                spec.weights as u32,
                bias.map_or(NONE, |bias| bias as u32),
                source.first as u32,
                result.first as u32,
            ],
            [ending, gate.first as u32, 0, 0],
        ])?;
        recorder.dispatch(
            kernel,
            &[
                uniform.as_ref(),
                parameters.as_ref(),
                source.buffer.as_ref(),
                gate.buffer.as_ref(),
                result.buffer.as_ref(),
            ],
            results.div_ceil(64) as u32,
        );
        Ok(())
    }

    /// Records the gradient by weights and bias of a layer that went `way`, at their places in `gradients`.
    pub(super) fn weight_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        way: Way,
        spec: &ConvSpec,
        source: &Tensor,
        d_result: &Tensor,
        gradients: &Buffer<f32>,
    ) -> Result<(), GpuError> {
        let (fine, coarse, biases) = match way {
            Way::Down => (source, d_result, spec.coarse),
            Way::Up => (d_result, source, spec.fine),
        };
        let uniform = recorder.uniform(&[
            [spec.fine as u32, spec.coarse as u32, spec.edge as u32, u32::from(way == Way::Up)],
            [fine.first as u32, coarse.first as u32, spec.weights as u32, spec.bias as u32],
        ])?;
        recorder.dispatch(
            &self.conv_weight_gradient,
            &[uniform.as_ref(), fine.buffer.as_ref(), coarse.buffer.as_ref(), gradients.as_ref()],
            (spec.weight_count() + biases).div_ceil(64) as u32,
        );
        Ok(())
    }
}
