//! Downsamples planes to latents and upsamples them again on the device, with gradients.
//!
//! Latents are rounded as they will be stored before upsampling, with straight-through gradients, so training sees the planes that a
//! file holds.

use std::sync::Arc;

use super::{
    convolution::{ConvLayer, Convolutions, Direction, Epilogue, Tensor},
    layout::ContextLayout,
};
use crate::gpu::{Buffer, GpuError, Kernel, Plan, Recorder, kernel_source, planned};

/// Which planes the networks sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlaneSource {
    /// The raw planes.
    Raw,
    /// The raw planes' reconstruction from rounded latents.
    Reconstructed,
    /// The reconstruction from latents that are parameters of their own, rounded.
    Latents,
}

/// Intermediate tensors between planes and latents, or their gradients.
#[derive(Debug)]
struct Tensors {
    /// Outputs of the layers down; the last are the latents before rounding.
    down: Vec<Tensor>,
    /// Latents.
    latents: Tensor,
    /// Outputs of the layers up; the last are the planes.
    up: Vec<Tensor>,
}

impl Tensors {
    fn plan(layout: &ContextLayout) -> Plan<'static, Self> {
        let tensor = |values: usize| Tensor::plan("planes and latents", values);
        planned!(Self {
            down: Plan::all(layout.down.iter().map(|layer| tensor(layer.coarse_values()))),
            latents: tensor(layout.config.planes.latent_values()),
            up: Plan::all(layout.up.iter().map(|layer| tensor(layer.fine_values()))),
        })
    }

    fn planes(&self) -> &Tensor {
        self.up.last().unwrap_or(&self.latents)
    }
}

/// The planes that the networks sample.
#[derive(Debug)]
pub(super) struct PlanePass {
    convolutions: Convolutions,
    plane_l1: Arc<Kernel>,
    round_latents: Arc<Kernel>,
    on: Tensors,
    back: Tensors,
}

impl PlanePass {
    pub(super) fn plan(layout: &ContextLayout) -> Plan<'static, Self> {
        planned!(Self {
            convolutions: Convolutions::plan(),
            plane_l1: Plan::kernel(kernel_source!("plane_l1"), &[]),
            round_latents: Plan::kernel(kernel_source!("round_latents"), &[]),
            on: Tensors::plan(layout),
            back: Tensors::plan(layout),
        })
    }

    /// The tensor with the planes of `source`.
    pub(super) fn planes(
        &self,
        source: PlaneSource,
        layout: &ContextLayout,
        parameters: &Buffer<f32>,
    ) -> Tensor {
        match source {
            PlaneSource::Raw => Tensor::at(parameters, layout.planes.start),
            PlaneSource::Reconstructed | PlaneSource::Latents => self.on.planes().clone(),
        }
    }

    /// The tensor for the gradient by the planes of `source`: among the parameters' gradients if the planes are parameters.
    pub(super) fn plane_gradients(
        &self,
        source: PlaneSource,
        layout: &ContextLayout,
        gradients: &Buffer<f32>,
    ) -> Tensor {
        match source {
            PlaneSource::Raw => Tensor::at(gradients, layout.planes.start),
            PlaneSource::Reconstructed if layout.up.is_empty() => Tensor::at(gradients, layout.planes.start),
            PlaneSource::Latents if layout.up.is_empty() => Tensor::at(gradients, layout.latents.start),
            PlaneSource::Reconstructed | PlaneSource::Latents => self.back.planes().clone(),
        }
    }

    /// Records downsampling the raw planes; returns the tensor of latents, not rounded.
    pub(super) fn down(
        &self,
        recorder: &mut Recorder<'_>,
        layout: &ContextLayout,
        parameters: &Buffer<f32>,
    ) -> Result<Tensor, GpuError> {
        let mut source = Tensor::at(parameters, layout.planes.start);
        for (index, (spec, result)) in layout.down.iter().zip(&self.on.down).enumerate() {
            let epilogue = if index + 1 < layout.down.len() { Epilogue::Relu } else { Epilogue::Linear };
            let layer = ConvLayer { direction: Direction::Down, spec, parameters };
            self.convolutions.forward(recorder, layer, &source, result, epilogue)?;
            source = result.clone();
        }
        Ok(source)
    }

    /// Records rounding the latents and upsampling them to planes. `stored` are the parameters as they are used, perhaps
    /// rounded.
    pub(super) fn up(
        &self,
        recorder: &mut Recorder<'_>,
        layout: &ContextLayout,
        stored: &Buffer<f32>,
        latents: &Tensor,
    ) -> Result<(), GpuError> {
        let values = self.on.latents.buffer.len();
        let uniform = recorder.uniform(&[[values as u32, latents.first as u32, 0, 0]])?;
        recorder.dispatch(
            &self.round_latents,
            &[&uniform, &latents.buffer, &self.on.latents.buffer],
            values.div_ceil(64) as u32,
        );
        let mut source = &self.on.latents;
        for (index, (spec, result)) in layout.up.iter().zip(&self.on.up).enumerate() {
            let epilogue = if index + 1 < layout.up.len() { Epilogue::Relu } else { Epilogue::Linear };
            let layer = ConvLayer { direction: Direction::Up, spec, parameters: stored };
            self.convolutions.forward(recorder, layer, source, result, epilogue)?;
            source = result;
        }
        Ok(())
    }

    /// Records clearing the gradient by the reconstructed planes.
    pub(super) fn clear_gradients(&self, recorder: &mut Recorder<'_>) {
        recorder.clear(&self.back.planes().buffer);
    }

    /// Records adding the gradients of the mean absolute difference of raw and reconstructed planes.
    pub(super) fn reconstruction_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        layout: &ContextLayout,
        weight: f32,
        parameters: &Buffer<f32>,
        gradients: &Buffer<f32>,
    ) -> Result<(), GpuError> {
        let values = layout.planes.len();
        let share = weight / values.max(1) as f32;
        let uniform = recorder.uniform(&[[values as u32, layout.planes.start as u32, share.to_bits(), 0]])?;
        recorder.dispatch(
            &self.plane_l1,
            &[&uniform, parameters, &self.on.planes().buffer, gradients, &self.back.planes().buffer],
            values.div_ceil(64) as u32,
        );
        Ok(())
    }

    /// Records the gradients by the layers up and by the latents from those by their planes; returns the tensor of the
    /// latents' gradients. There must be at least one layer.
    pub(super) fn up_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        layout: &ContextLayout,
        stored: &Buffer<f32>,
        gradients: &Buffer<f32>,
        d_latents: &Tensor,
    ) -> Result<(), GpuError> {
        for (index, spec) in layout.up.iter().enumerate().rev() {
            let source = if index == 0 { &self.on.latents } else { &self.on.up[index - 1] };
            let d_result = &self.back.up[index];
            self.convolutions.weight_gradient(recorder, Direction::Up, spec, source, d_result, gradients)?;
            let (d_source, epilogue) = if index == 0 {
                (d_latents, Epilogue::Linear)
            } else {
                (&self.back.up[index - 1], Epilogue::Gate(source))
            };
            let layer = ConvLayer { direction: Direction::Up, spec, parameters: stored };
            self.convolutions.input_gradient(recorder, layer, d_result, d_source, epilogue)?;
        }
        Ok(())
    }

    /// The tensor for the gradient by latents that are not parameters.
    pub(super) fn latent_gradients(&self) -> &Tensor {
        self.back.down.last().unwrap_or(&self.back.latents)
    }

    /// Records the gradients by the layers down from those by the latents, and adds the gradients by raw planes.
    pub(super) fn down_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        layout: &ContextLayout,
        parameters: &Buffer<f32>,
        gradients: &Buffer<f32>,
    ) -> Result<(), GpuError> {
        let planes = Tensor::at(parameters, layout.planes.start);
        let d_planes = Tensor::at(gradients, layout.planes.start);
        for (index, spec) in layout.down.iter().enumerate().rev() {
            let source = if index == 0 { &planes } else { &self.on.down[index - 1] };
            let d_result = &self.back.down[index];
            self.convolutions.weight_gradient(
                recorder,
                Direction::Down,
                spec,
                source,
                d_result,
                gradients,
            )?;
            let (d_source, epilogue) = if index == 0 {
                (&d_planes, Epilogue::Add)
            } else {
                (&self.back.down[index - 1], Epilogue::Gate(source))
            };
            let layer = ConvLayer { direction: Direction::Down, spec, parameters };
            self.convolutions.input_gradient(recorder, layer, d_result, d_source, epilogue)?;
        }
        Ok(())
    }
}
