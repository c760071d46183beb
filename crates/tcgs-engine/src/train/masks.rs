//! Learnt offset masks (TC-GS II-C, METHOD.md §4.1): one logit an offset, whose sign against a level decides whether the offset
//! makes a Gaussian at all.
//!
//! The rendered mask is binary and its gradient straight-through: opacities pass on what the rendering loss says, the mask
//! loss pulls every logit down at the same rate, the rate term pulls it by the bits of its offset's coordinates, and Adam
//! weighs them by their sizes, so that an offset whose opacity matters little to any view goes first. A masked offset is not
//! rendered and costs no bits, so nothing pulls it up again: masking is one-way.

use std::sync::Arc;

use super::{
    Adam, AdamStep, Moments,
    context::{AnchorSample, RateTerm},
};
use crate::{
    gpu::{Buffer, Device, GpuError, Kernel, Plan, Recorder, kernel_source, planned},
    model::ModelShape,
    render::{DeviceAnchors, NeuralGaussians, RenderError},
};

/// The initial logit: a logistic of 0.731.
pub const FIRST_LOGIT: f32 = 1.0;

/// The logits with their moments, on the host: `[N][K]` each.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MaskRows {
    /// The logits.
    pub logits: Vec<f32>,
    /// Their first moments.
    pub first: Vec<f32>,
    /// Their second moments.
    pub second: Vec<f32>,
}

impl MaskRows {
    /// The initial state of `offsets` offsets, none masked.
    #[must_use]
    pub fn new(offsets: usize) -> Self {
        let mut rows = Self::default();
        rows.extend(offsets);
        rows
    }

    /// Adds `offsets` more.
    pub(super) fn extend(&mut self, offsets: usize) {
        let len = self.logits.len() + offsets;
        self.logits.resize(len, FIRST_LOGIT);
        self.first.resize(len, 0.0);
        self.second.resize(len, 0.0);
    }
}

#[derive(Debug)]
struct Kernels {
    mask_loss: Arc<Kernel>,
    mask_gradient: Arc<Kernel>,
    mask_bits: Arc<Kernel>,
    mask_rate: Arc<Kernel>,
}

/// Learning masks on the device.
#[derive(Debug)]
pub struct OffsetMasks {
    kernels: Kernels,
    logits: Buffer<f32>,
    gradients: Buffer<f32>,
    moments: Moments,
}

impl OffsetMasks {
    /// Plans the masks of `anchors` anchors of this shape.
    #[must_use]
    pub fn plan(shape: ModelShape, anchors: usize) -> Plan<'static, Self> {
        let (defs, offsets) = (shape.defs(), anchors * shape.offsets);
        planned!(Self {
            kernels: planned!(Kernels {
                mask_loss: Plan::kernel(kernel_source!("mask_loss"), &defs),
                mask_gradient: Plan::kernel(kernel_source!("mask_gradient"), &defs),
                mask_bits: Plan::kernel(kernel_source!("mask_bits"), &defs),
                mask_rate: Plan::kernel(kernel_source!("mask_rate"), &defs),
            }),
            logits: Plan::buffer("mask logits", offsets),
            gradients: Plan::buffer("gradients of mask logits", offsets),
            moments: Moments::plan(offsets),
        })
    }

    /// Uploads the logits of anchors of this shape.
    pub fn upload(device: &Device, shape: ModelShape, rows: &MaskRows) -> Result<Self, GpuError> {
        let made = Self::plan(shape, rows.logits.len() / shape.offsets).make(device)?;
        device.write(&made.logits, &rows.logits);
        device.write(&made.moments.first, &rows.first);
        device.write(&made.moments.second, &rows.second);
        Ok(made)
    }

    /// The logits with their moments. Waits for the device.
    pub fn read(&self, device: &Device) -> Result<MaskRows, GpuError> {
        Ok(MaskRows {
            logits: device.read(&self.logits)?,
            first: device.read(&self.moments.first)?,
            second: device.read(&self.moments.second)?,
        })
    }

    /// Records the gradients by the logits: `weight` times the mean logistic over all offsets, and what the view of
    /// `neural`'s last forward and the rasterizer's last backward pass say.
    ///
    /// # Errors
    /// [`RenderError::OutOfStep`] before a backward pass; errors of the device.
    pub fn backward(
        &self,
        recorder: &mut Recorder<'_>,
        neural: &mut NeuralGaussians,
        anchors: &DeviceAnchors,
        weight: f32,
    ) -> Result<&Buffer<f32>, RenderError> {
        let offsets = self.logits.len();
        let share = weight / offsets.max(1) as f32;
        let settings =
            recorder.uniform(&[[share, 0.0, 0.0, 0.0], [f32::from_bits(offsets as u32), 0.0, 0.0, 0.0]])?;
        recorder.dispatch(
            &self.kernels.mask_loss,
            &[&settings, &self.logits, &self.gradients],
            offsets.div_ceil(64) as u32,
        );
        let d_geometry = neural.gaussian_gradients()?.geometry.clone();
        recorder.dispatch(
            &self.kernels.mask_gradient,
            &[
                neural.visible_list(),
                &neural.gaussians().geometry,
                &d_geometry,
                &self.logits,
                &self.gradients,
            ],
            anchors.count.div_ceil(64) as u32,
        );
        Ok(&self.gradients)
    }

    /// Records the adding of the rate term's gradient to that of [`Self::backward`]: the mask multiplies the bits of its offset's
    /// coordinates, of which `rate` has recorded those of `sample`; `lambda` weighs bits an element of the sample.
    pub fn rate_backward(
        &self,
        recorder: &mut Recorder<'_>,
        rate: &RateTerm,
        sample: AnchorSample<'_>,
        lambda: f64,
    ) -> Result<(), GpuError> {
        let weight = rate.weight(lambda, sample.count);
        let capacity = f32::from_bits(rate.capacity() as u32);
        let settings = recorder.uniform(&[[weight, 0.0, 0.0, 0.0], [capacity, 0.0, 0.0, 0.0]])?;
        recorder.dispatch(
            &self.kernels.mask_rate,
            &[&settings, sample.list, rate.bits(), &self.logits, &self.gradients],
            sample.count.div_ceil(64) as u32,
        );
        Ok(())
    }

    /// Records an optimizer step with the last gradients, then the masks: an offset makes Gaussians while its logit is above
    /// `level`.
    pub fn step(
        &self,
        recorder: &mut Recorder<'_>,
        adam: &Adam,
        step: AdamStep<'_>,
        learning_rate: f32,
        level: f32,
        anchors: &DeviceAnchors,
    ) -> Result<(), GpuError> {
        let learning_rates = recorder.uniform(&[learning_rate])?;
        adam.step(recorder, step, &learning_rates, &self.gradients, &self.logits, &self.moments)?;
        let settings = recorder
            .uniform(&[[level, 0.0, 0.0, 0.0], [f32::from_bits(anchors.count as u32), 0.0, 0.0, 0.0]])?;
        recorder.dispatch(
            &self.kernels.mask_bits,
            &[&settings, &self.logits, &anchors.masks],
            anchors.count.div_ceil(64) as u32,
        );
        Ok(())
    }
}
