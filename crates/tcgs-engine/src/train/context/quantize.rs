//! Quantizes rows for rendering during training: first by noise as wide as the quantization steps, then by rounding
//! (METHOD.md §4.2).
//!
//! Noise is a hash of seed, step, anchor and column, so a repeated step has the same noise. Scalings are quantized as linear values,
//! not as logarithms, and are at least one step, as a file stores them.

use std::sync::Arc;

use crate::{
    gpu::{Buffer, Device, GpuError, Kernel, Plan, Recorder, kernel_source, planned},
    model::ModelShape,
    render::DeviceAnchors,
};

/// How values are quantized for rendering.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum QuantizationPhase {
    /// Uniform noise as wide as the base steps.
    FixedNoise = 0,
    /// Uniform noise as wide as each anchor's own steps.
    Noise = 1,
    /// The nearest multiples of each anchor's own steps.
    Rounded = 2,
}

/// The quantization of one training step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quantization {
    /// How.
    pub phase: QuantizationPhase,
    /// Base steps of features, scalings and offsets; positive.
    pub base_quant_steps: [f32; 3],
    /// Seed of the noise; see [`Quantization::key`].
    pub key: u32,
}

impl Quantization {
    /// The noise's key in step `step` of a run with this seed.
    #[must_use]
    pub fn key(seed: u64, step: u32) -> u32 {
        let halves = [seed as u32, (seed >> 32) as u32, step];
        halves.into_iter().fold(0, |key, part| pcg_hash(key ^ pcg_hash(part)))
    }

    pub(super) fn uniform(&self, anchors: usize) -> QuantizationUniform {
        let [features, scalings, offsets] = self.base_quant_steps;
        QuantizationUniform {
            shape: [anchors as u32, self.phase as u32, self.key, 0],
            base: [features, scalings, offsets, 0.0],
        }
    }
}

/// The uniform of `shaders/shared/quantize.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct QuantizationUniform {
    shape: [u32; 4],
    base: [f32; 4],
}

/// The PCG hash: one round and its output permutation.
pub(in super::super) fn pcg_hash(value: u32) -> u32 {
    let state = value.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    let word = ((state >> ((state >> 28) + 4)) ^ state).wrapping_mul(277_803_737);
    (word >> 22) ^ word
}

/// Rendered rows on the device, with each anchor's quantization steps and the gradients by them.
#[derive(Debug)]
pub struct QuantizedRows {
    quantize_rows: Arc<Kernel>,
    quantize_gradient: Arc<Kernel>,
    rows: Buffer<f32>,
    steps: Buffer<f32>,
    d_log_quant_steps: Buffer<f32>,
}

impl QuantizedRows {
    /// Plans the rendered rows of `anchors` anchors.
    #[must_use]
    pub fn plan(shape: ModelShape, anchors: usize) -> Plan<'static, Self> {
        planned!(Self {
            quantize_rows: Plan::kernel(kernel_source!("quantize_rows"), &shape.defs()),
            quantize_gradient: Plan::kernel(kernel_source!("quantize_gradient"), &shape.defs()),
            rows: Plan::buffer("rendered rows", anchors * shape.row()),
            steps: Plan::buffer("steps of anchors", 3 * anchors),
            d_log_quant_steps: Plan::buffer("gradients of steps", 3 * anchors),
        })
    }

    /// The rendered rows of anchors whose steps are `[N][3]`: features, scalings, offsets.
    pub fn upload(device: &Device, shape: ModelShape, steps: &[f32]) -> Result<Self, GpuError> {
        let made = Self::plan(shape, steps.len() / 3).make(device)?;
        device.write(&made.steps, steps);
        Ok(made)
    }

    /// The rendered rows, `[N][row]`, scalings as logarithms.
    #[must_use]
    pub fn rows(&self) -> &Buffer<f32> {
        &self.rows
    }

    /// Each anchor's steps, `[N][3]`. [`super::RateTerm::record`] refreshes those of the anchors that it samples; nothing
    /// else changes them.
    #[must_use]
    pub fn steps(&self) -> &Buffer<f32> {
        &self.steps
    }

    /// The rendering loss's gradients by the base-2 logarithms of those steps, `[N][3]`, after
    /// [`Self::record_backward`].
    #[must_use]
    pub fn log_quant_step_gradients(&self) -> &Buffer<f32> {
        &self.d_log_quant_steps
    }

    /// The anchors with the rendered rows for their own; networks and all else are shared.
    #[must_use]
    pub fn rendered(&self, anchors: &DeviceAnchors) -> DeviceAnchors {
        DeviceAnchors {
            shape: anchors.shape,
            count: anchors.count,
            positions: anchors.positions.clone(),
            rows: self.rows.clone(),
            masks: anchors.masks.clone(),
            networks: anchors.networks.clone(),
        }
    }

    /// Records the quantization of the rows. Masked offsets are copied.
    pub fn record_forward(
        &self,
        recorder: &mut Recorder<'_>,
        anchors: &DeviceAnchors,
        quantization: &Quantization,
    ) -> Result<(), GpuError> {
        let settings = recorder.uniform(&[quantization.uniform(anchors.count)])?;
        let a_lane = recorder.variant().choose(anchors.shape.row(), 1);
        recorder.dispatch(
            &self.quantize_rows,
            &[&settings, &anchors.rows, &anchors.masks, &self.steps, &self.rows],
            (anchors.count * anchors.shape.row() / a_lane).div_ceil(64) as u32,
        );
        Ok(())
    }

    /// Records the backward pass: turns `d_rows` from the gradients by the rendered rows into those by the anchors' rows.
    /// `anchors` and `quantization` are those of the forward pass.
    pub fn record_backward(
        &self,
        recorder: &mut Recorder<'_>,
        anchors: &DeviceAnchors,
        quantization: &Quantization,
        d_rows: &Buffer<f32>,
    ) -> Result<(), GpuError> {
        let settings = recorder.uniform(&[quantization.uniform(anchors.count)])?;
        recorder.dispatch(
            &self.quantize_gradient,
            &[&settings, &anchors.rows, &anchors.masks, &self.steps, d_rows, &self.d_log_quant_steps],
            anchors.count.div_ceil(64) as u32,
        );
        Ok(())
    }
}
