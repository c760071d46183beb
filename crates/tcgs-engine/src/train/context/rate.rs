//! The rate term: the bits of the sampled anchors in a file under the distributions that the context networks predict
//! (TC-GS (4), METHOD.md §4.5), in a form that stays right where symbols are badly predicted.
//!
//! A value costs -log2 of the normal distribution's mass in its bin. The usual difference of two error functions in f32 is
//! wrong beyond 16 bits and flat beyond 20, so that what is predicted worst is never pulled back; here each case has a form
//! without cancellation (`shaders/shared/gaussian.wgsl`).
//!
//! Largest errors of the device (lavapipe) against 20 256 independent values in f64, by the value's bits. Derivatives are
//! relative, that by the logarithm of the standard deviation to the larger of its two terms, and below 10^-6 count as
//! none:
//!
//! | bits | of the bits | by value | by log deviation | by log width |
//! |---|---|---|---|---|
//! | below 8 | 2.7e-6 | 6.0e-5 | 1.3e-6 | 6.0e-5 |
//! | 8 to 30 | 9.8e-6 | 2.0e-5 | 7.9e-7 | 7.1e-7 |
//! | 30 to 100 | 6.4e-5 | 4.3e-7 | 3.9e-7 | 3.6e-7 |
//! | 100 to 10^9 | 1.3e-6, relative | 6.4e-7 | 4.3e-7 | 6.3e-7 |
//!
//! A group's bits are what a file takes: a value far out costs no more than an escape there, 26 bits and twice the base-2 logarithm of
//! one more than its distance in steps (`FORMAT.md`), or one stray anchor would make an estimate of the file's size of its own.
//! Gradients, and the offsets' bits that masks learn from, are the distribution's own, so that strays are pulled back.
//!
//! What always holds: every gradient is finite, whatever rows and networks hold; a number that is none costs nothing and
//! teaches nothing. Where the decoder knows no finer or wider distribution (standard deviations from 2^-3.5 to 2^10.28
//! steps), the nearest that it knows is taken, and of the gradient by the standard deviation only what leads back inside
//! passes; adjustments beyond 3.5 octaves have no gradient. A value's derivatives, counted in steps and octaves, go no
//! further than 10^4, which is what one 100 standard deviations away has by its logarithm: the networks are shared, and one
//! stray anchor must not drown the others.
//!
//! In the phase that rounds, mean, standard deviation and step are those that the decoder's integers stand for
//! (sixteenths of a step, multiples of 7/32 octave), with the gradient of what was rounded.

use std::sync::Arc;

use super::{Quantization, QuantizedRows, quantize::QuantizationUniform};
use crate::{
    domain::AttributeGroup,
    gpu::{Buffer, Device, GpuError, Kernel, Plan, Recorder, kernel_source, planned},
    model::ModelShape,
    render::DeviceAnchors,
};

/// Groups of attributes.
const GROUPS: usize = AttributeGroup::ALL.len();

#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct RateUniform {
    quantization: QuantizationUniform,
    group: [u32; 4],
    room: [u32; 4],
    weights: [f32; 4],
}

/// The anchors whose bits a step estimates, each once.
#[derive(Debug, Clone, Copy)]
pub struct AnchorSample<'a> {
    /// How many, then their indices.
    pub list: &'a Buffer<u32>,
    /// How many, at most [`RateTerm::capacity`].
    pub count: usize,
    /// Columns that the networks' outputs have room for.
    pub capacity: usize,
}

/// The outputs of the groups' networks for the sampled anchors, and the gradients by them. Both are column-major with the
/// sample's capacity; of each group means in base steps, logarithms of standard deviations in octaves of base steps, a step
/// adjustment.
#[derive(Debug, Clone, Copy)]
pub struct SampleOutputs<'a> {
    /// The outputs.
    pub values: &'a Buffer<f32>,
    /// Their gradients; those of the sampled anchors are overwritten.
    pub gradients: &'a Buffer<f32>,
    /// First row of each group in both.
    pub first_rows: [usize; GROUPS],
}

/// What a pass of the rate term measures.
#[derive(Debug, Clone, Copy)]
pub struct RateInputs<'a> {
    /// The anchors.
    pub anchors: &'a DeviceAnchors,
    /// Their quantized rows, after [`QuantizedRows::record_backward`].
    pub quantized: &'a QuantizedRows,
    /// How those rows were quantized; the phase uses each anchor's own quantization steps.
    pub quantization: &'a Quantization,
    /// The anchors whose bits are estimated.
    pub sample: AnchorSample<'a>,
    /// What the context networks predict for them.
    pub outputs: SampleOutputs<'a>,
    /// Weight of the bits per element of the sample in the loss.
    pub lambda: f64,
}

/// The rate term: its kernels and the bits of the last sample.
#[derive(Debug)]
pub struct RateTerm {
    rate: Arc<Kernel>,
    refresh_quant_steps: Arc<Kernel>,
    sum_bits: Arc<Kernel>,
    shape: ModelShape,
    capacity: usize,
    bits: Buffer<f32>,
    sums: Buffer<f32>,
}

impl RateTerm {
    /// Plans the rate of samples of up to `capacity` anchors.
    #[must_use]
    pub fn plan(shape: ModelShape, capacity: usize) -> Plan<'static, Self> {
        planned!(Self {
            rate: Plan::kernel(kernel_source!("rate"), &shape.defs()),
            refresh_quant_steps: Plan::kernel(kernel_source!("refresh_quant_steps"), &[]),
            sum_bits: Plan::kernel(kernel_source!("sum_bits"), &[]),
            shape: Plan::value(shape),
            capacity: Plan::value(capacity),
            bits: Plan::buffer("bits of the sample", (GROUPS + shape.offsets) * capacity),
            sums: Plan::buffer("sums of bits", GROUPS),
        })
    }

    /// The same with room for samples of up to `capacity` anchors. The sums of the last sample stay.
    pub fn with_capacity(self, device: &Device, capacity: usize) -> Result<Self, GpuError> {
        let roomier = Self::plan(self.shape, capacity).make(device)?;
        Ok(Self { sums: self.sums, ..roomier })
    }

    /// Largest number of anchors in a sample.
    #[must_use]
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// The weight of one bit if the loss has `lambda` times the sample's bits per element.
    #[must_use]
    pub fn weight(&self, lambda: f64, sampled: usize) -> f32 {
        (lambda / (sampled * self.shape.row()).max(1) as f64) as f32
    }

    /// Records the bits of the sample and refreshes its anchors' quantization steps unless `overflow_flag` is set by then.
    ///
    /// The gradients are added to `d_rows`, which holds the rendering loss's gradients by the anchors' rows. The rendering loss's
    /// gradients by the sampled quantization steps, scaled up to all anchors, are added to those of the step adjustments.
    pub fn record(
        &self,
        recorder: &mut Recorder<'_>,
        inputs: &RateInputs<'_>,
        d_rows: &Buffer<f32>,
        overflow_flag: &Buffer<u32>,
    ) -> Result<(), GpuError> {
        let RateInputs { anchors, quantized, quantization, sample, outputs, lambda } = *inputs;
        let shape = self.shape;
        let columns = [0, shape.scaling_column(), shape.offset_column(), shape.row()];
        let scaled_up = anchors.count as f64 / sample.count.max(1) as f64;
        let settings: [RateUniform; GROUPS] = std::array::from_fn(|place| {
            let [first, end] = [columns[place], columns[place + 1]];
            let first_row = outputs.first_rows[place];
            RateUniform {
                quantization: quantization.uniform(anchors.count),
                group: [first as u32, (end - first) as u32, place as u32, first_row as u32],
                room: [sample.capacity as u32, self.capacity as u32, 0, 0],
                weights: [self.weight(lambda, sample.count), scaled_up as f32, 0.0, 0.0],
            }
        });
        let settings = recorder.uniform(&settings)?;
        let workgroups = (GROUPS * sample.count.div_ceil(64)) as u32;
        recorder.dispatch(
            &self.rate,
            &[
                &settings,
                sample.list,
                &anchors.rows,
                &anchors.masks,
                outputs.values,
                quantized.log_quant_step_gradients(),
                outputs.gradients,
                d_rows,
                &self.bits,
            ],
            workgroups,
        );
        recorder.dispatch(
            &self.refresh_quant_steps,
            &[&settings, sample.list, outputs.values, overflow_flag, quantized.steps()],
            workgroups,
        );
        let room = recorder.uniform(&[[self.capacity as u32, 0, 0, 0]])?;
        recorder.dispatch(&self.sum_bits, &[&room, sample.list, &self.bits, &self.sums], GROUPS as u32);
        Ok(())
    }

    /// Bits of the last recorded sample, column-major with [`Self::capacity`]: a row for each group, of what a file takes, then
    /// one for each offset under the distribution, which is zero where it is masked.
    #[must_use]
    pub fn bits(&self) -> &Buffer<f32> {
        &self.bits
    }

    /// Bits that a file takes for the last submitted sample, by group. Waits for the device.
    pub fn sums(&self, device: &Device) -> Result<[f64; GROUPS], GpuError> {
        Ok(Self::sums_of(&device.read(&self.sums)?))
    }

    /// Where those bits are.
    #[must_use]
    pub fn bits_by_group(&self) -> &Buffer<f32> {
        &self.sums
    }

    /// The bits in a copy of [`Self::bits_by_group`].
    #[must_use]
    pub fn sums_of(bits: &[f32]) -> [f64; GROUPS] {
        std::array::from_fn(|group| bits.get(group).copied().map_or(0.0, f64::from))
    }
}
