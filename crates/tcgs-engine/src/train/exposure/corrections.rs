//! Affine color corrections of the training photographs on the device (METHOD.md §2.11).
//!
//! A correction is three rows, each a row of A and then the component of b. Invariants: after every step the mean over all photographs
//! is the identity, so that the scene has no tint; a step whose forward pass overflowed changes nothing.

use std::sync::Arc;

use super::Learning;
use crate::{
    gpu::{Buffer, Device, GpuError, Kernel, Plan, Recorder, buffer_bytes, kernel_source, planned},
    train::{
        adam::{BETAS, EPSILON},
        checkpoint::{CheckpointError, ModelState},
    },
};

/// Rows of a correction.
const ROWS: usize = 3;

/// The correction that changes nothing.
const IDENTITY: [[f32; 4]; ROWS] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// Pixels of a partial sum, as in `shaders/exposure/correct_colors_gradient.wgsl`.
const PIXELS_A_SUM: usize = 1024;

/// Names of the arrays in checkpoints.
const ARRAYS: [&str; 3] = ["corrections", "corrections.first", "corrections.second"];

#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct StepUniform {
    shape: [u32; 4],
    moments: [f32; 4],
    extra: [f32; 4],
}

#[derive(Debug)]
struct Kernels {
    correct: Arc<Kernel>,
    gradient: Arc<Kernel>,
    step: Arc<Kernel>,
}

/// Corrections with their moments, three rows a photograph.
#[derive(Debug)]
struct Rows {
    values: Buffer<[f32; 4]>,
    first: Buffer<[f32; 4]>,
    second: Buffer<[f32; 4]>,
}

impl Rows {
    fn plan(photographs: usize) -> Plan<'static, Self> {
        let len = ROWS * photographs;
        planned!(Self {
            values: Plan::buffer("color corrections", len),
            first: Plan::buffer("first moments of color corrections", len),
            second: Plan::buffer("second moments of color corrections", len),
        })
    }
}

/// Buffers of the last image; those of smaller images have room to spare.
#[derive(Debug)]
struct Fields {
    corrected: Buffer<[f32; 4]>,
    sums: Buffer<[f32; 4]>,
}

impl Fields {
    fn plan(pixels: usize, old: Option<&Self>) -> Plan<'_, Self> {
        let sums = ROWS * pixels.div_ceil(PIXELS_A_SUM);
        planned!(Self {
            corrected: Plan::resized("corrected render", pixels, old.map(|old| &old.corrected)),
            sums: Plan::resized("gradient of a color correction", sums, old.map(|old| &old.sums)),
        })
    }
}

/// The corrections of a run's photographs.
#[derive(Debug)]
pub struct ColorCorrections {
    device: Arc<Device>,
    kernels: Kernels,
    photographs: usize,
    rows: Rows,
    fields: Option<Fields>,
}

impl ColorCorrections {
    /// Corrections that change nothing yet.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn new(device: &Arc<Device>, photographs: usize) -> Result<Self, GpuError> {
        let kernels = Kernels {
            correct: device.kernel(kernel_source!("correct_colors"), &[])?,
            gradient: device.kernel(kernel_source!("correct_colors_gradient"), &[])?,
            step: device.kernel(kernel_source!("correction_step"), &[])?,
        };
        let rows = Rows::plan(photographs).make(device)?;
        device.write(&rows.values, &vec![IDENTITY; photographs].concat());
        Ok(Self { device: Arc::clone(device), kernels, photographs, rows, fields: None })
    }

    /// Bytes on the device once images of up to `pixels` pixels were corrected.
    #[must_use]
    pub(in crate::train) fn bytes(photographs: usize, pixels: usize) -> u64 {
        let uniforms = 2 * buffer_bytes::<[u32; 4]>(1) + buffer_bytes::<StepUniform>(1);
        Rows::plan(photographs).bytes() + Fields::plan(pixels, None).bytes() + uniforms
    }

    /// Records the correction of a render of `pixels` pixels; returns what the loss compares with the photograph.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn correct(
        &mut self,
        recorder: &mut Recorder<'_>,
        photograph: usize,
        render: &Buffer<[f32; 4]>,
        pixels: usize,
    ) -> Result<Buffer<[f32; 4]>, GpuError> {
        let fields = Fields::plan(pixels, self.fields.as_ref()).make(&self.device)?;
        let Fields { corrected, .. } = self.fields.insert(fields);
        let shape = recorder.uniform(&[[pixels as u32, photograph as u32, 0, 0]])?;
        recorder.dispatch(
            &self.kernels.correct,
            &[&shape, &self.rows.values, render, corrected],
            pixels.div_ceil(64) as u32,
        );
        Ok(corrected.clone())
    }

    /// Records the way of `d_image`, the loss's gradient by the corrected render of the last [`Self::correct`], back to the render, and
    /// the step of the photograph's correction, unless `overflow_flag` is set by then.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn learn(
        &mut self,
        recorder: &mut Recorder<'_>,
        learning: Learning,
        render: &Buffer<[f32; 4]>,
        d_image: &Buffer<[f32; 4]>,
        overflow_flag: &Buffer<u32>,
    ) -> Result<(), GpuError> {
        let Some(Fields { corrected, sums }) = &self.fields else { return Ok(()) };
        let Learning { photograph, visit, learning_rate } = learning;
        let (pixels, Rows { values, first, second }) = (corrected.len(), &self.rows);
        let groups = pixels.div_ceil(PIXELS_A_SUM) as u32;
        let shape = recorder.uniform(&[[pixels as u32, photograph as u32, 0, 0]])?;
        recorder.dispatch(&self.kernels.gradient, &[&shape, values, render, d_image, sums], groups);
        let powers = BETAS.map(|beta| 1.0 - beta.powi(i32::try_from(visit).unwrap_or(i32::MAX)));
        let uniform = recorder.uniform(&[StepUniform {
            shape: [self.photographs as u32, photograph as u32, groups, 0],
            moments: [
                BETAS[0] as f32,
                BETAS[1] as f32,
                (1.0 / powers[0]) as f32,
                (1.0 / powers[1].sqrt()) as f32,
            ],
            extra: [EPSILON, (1.0 - BETAS[0]) as f32, (1.0 - BETAS[1]) as f32, learning_rate as f32],
        }])?;
        recorder.dispatch(&self.kernels.step, &[&uniform, sums, values, first, second, overflow_flag], 1);
        Ok(())
    }

    /// The corrections. Waits for the device.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn read(&self) -> Result<Vec<[[f32; 4]; 3]>, GpuError> {
        let rows = self.device.read(&self.rows.values)?;
        Ok(rows.chunks_exact(ROWS).map(|rows| [rows[0], rows[1], rows[2]]).collect())
    }

    /// Adds everything that the next step depends on to `state`. Waits for the device.
    pub(in crate::train) fn save(&self, state: &mut ModelState) -> Result<(), GpuError> {
        let Rows { values, first, second } = &self.rows;
        for (name, buffer) in ARRAYS.into_iter().zip([values, first, second]) {
            state.put(name, self.device.read(buffer)?.concat());
        }
        Ok(())
    }

    /// Takes from `state` what [`Self::save`] put there.
    pub(in crate::train) fn restore(&self, state: &mut ModelState) -> Result<(), CheckpointError> {
        let Rows { values, first, second } = &self.rows;
        for (name, buffer) in ARRAYS.into_iter().zip([values, first, second]) {
            let saved: Vec<f32> = state.take_exactly(name, 4 * buffer.len())?;
            self.device.write(buffer, bytemuck::cast_slice::<f32, [f32; 4]>(&saved));
        }
        Ok(())
    }
}
