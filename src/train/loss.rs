//! The image loss on the device: 0.8 L1 + 0.2 (1 - SSIM) (method.md §1.5) and, where asked for, the wavelet constraint;
//! with its gradient.

use std::sync::Arc;

use super::WaveletWeights;
use crate::gpu::{Buffer, Context, GpuError, Kernel, Recorder, buffer_bytes, kernel_source};

/// Weight of the SSIM part; L1 has the rest.
const SSIM_WEIGHT: f64 = 0.2;

/// Pixels that one partial sum covers, as in `shaders/sum_losses.wgsl`.
const SUM_RUN: usize = 4096;

/// Pixels in line that one invocation of a windowed kernel makes, as in `shaders/shared/ssim.wgsl`.
const WINDOW_RUN: usize = 8;

#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ImageUniform {
    size: [u32; 4],
    weights: [f32; 4],
}

#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ConstraintUniform {
    size: [u32; 4],
    fine: [f32; 4],
    coarse: [f32; 4],
}

impl ConstraintUniform {
    /// Every weight divided by the samples of its band.
    fn new([width, height]: [u32; 2], weights: &WaveletWeights) -> Self {
        let halves = [width.div_ceil(2), height.div_ceil(2)];
        let quarters = [width.div_ceil(4), height.div_ceil(4)];
        let share = |[across, down]: [u32; 2], low: f64, [lh, hl, hh]: [f64; 3]| {
            let samples = 3.0 * f64::from(across) * f64::from(down);
            [low, lh, hl, hh].map(|weight| (weight / samples) as f32)
        };
        Self {
            size: [width, height, quarters[0], quarters[0] * quarters[1]],
            fine: share(halves, 0.0, weights.fine),
            coarse: share(quarters, weights.low, weights.coarse),
        }
    }
}

#[derive(Debug)]
struct Kernels {
    rows: Arc<Kernel>,
    columns: Arc<Kernel>,
    gradient_rows: Arc<Kernel>,
    gradient: Arc<Kernel>,
    wavelet: Arc<Kernel>,
    sums: Arc<Kernel>,
}

#[derive(Debug)]
struct Fields {
    size: [u32; 2],
    photograph: Buffer<u32>,
    moments: Buffer<f32>,
    derivatives: Buffer<f32>,
    blurred: Buffer<f32>,
    losses: Buffer<[f32; 4]>,
    sums: Buffer<[f32; 4]>,
    gradient: Buffer<[f32; 4]>,
}

/// What render and photograph differ by: means over all samples of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossSums {
    /// Mean SSIM.
    pub ssim: f64,
    /// Mean absolute difference.
    pub l1: f64,
    /// Mean squared difference.
    pub mse: f64,
    /// The wavelet constraint as it counts in the loss; 0 where it is off.
    pub wavelet: f64,
}

impl LossSums {
    /// 0.8 L1 + 0.2 (1 - SSIM), and the wavelet constraint.
    #[must_use]
    pub fn loss(&self) -> f64 {
        (1.0 - SSIM_WEIGHT) * self.l1 + SSIM_WEIGHT * (1.0 - self.ssim) + self.wavelet
    }

    /// PSNR of the unquantised render in dB, at most 100.
    #[must_use]
    pub fn psnr(&self) -> f64 {
        -10.0 * self.mse.max(1e-10).log10()
    }
}

/// Compares renders with photographs.
#[derive(Debug)]
pub struct ImageLoss {
    context: Arc<Context>,
    kernels: Kernels,
    fields: Option<Fields>,
}

impl ImageLoss {
    /// Prepares the kernels.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn new(context: Arc<Context>) -> Result<Self, GpuError> {
        let kernels = Kernels {
            rows: context.kernel(kernel_source!("ssim_rows"), &[])?,
            columns: context.kernel(kernel_source!("ssim_columns"), &[])?,
            gradient_rows: context.kernel(kernel_source!("ssim_gradient_rows"), &[])?,
            gradient: context.kernel(kernel_source!("image_gradient"), &[])?,
            wavelet: context.kernel(kernel_source!("wavelet"), &[])?,
            sums: context.kernel(kernel_source!("sum_losses"), &[])?,
        };
        Ok(Self { context, kernels, fields: None })
    }

    /// Bytes on the device once images of `size` were compared.
    #[must_use]
    pub fn bytes(size: [u32; 2]) -> u64 {
        let pixels = size[0] as usize * size[1] as usize;
        buffer_bytes::<ImageUniform>(1)
            + buffer_bytes::<ConstraintUniform>(1)
            + buffer_bytes::<u32>(pixels)
            + buffer_bytes::<f32>(4 * 3 * pixels)
            + 2 * buffer_bytes::<f32>(3 * 3 * pixels)
            + 2 * buffer_bytes::<[f32; 4]>(pixels)
            + buffer_bytes::<[f32; 4]>(pixels.div_ceil(SUM_RUN))
    }

    /// Records the loss of `render` against `photograph` (packed 8-bit RGB, one word a pixel) and its gradient;
    /// without `wavelet` the constraint costs nothing.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn record(
        &mut self,
        recorder: &mut Recorder<'_>,
        size: [u32; 2],
        render: &Buffer<[f32; 4]>,
        photograph: &[u32],
        wavelet: Option<&WaveletWeights>,
    ) -> Result<&Buffer<[f32; 4]>, GpuError> {
        let pixels = size[0] as usize * size[1] as usize;
        let fields = match self.fields.take() {
            Some(fields) if fields.size == size => self.fields.insert(fields),
            _ => self.fields.insert(Fields {
                size,
                photograph: self.context.buffer("photograph", pixels)?,
                moments: self.context.buffer("SSIM moments", 4 * 3 * pixels)?,
                derivatives: self.context.buffer("SSIM derivatives", 3 * 3 * pixels)?,
                blurred: self.context.buffer("SSIM derivatives by rows", 3 * 3 * pixels)?,
                losses: self.context.buffer("losses", pixels)?,
                sums: self.context.buffer("loss sums", pixels.div_ceil(SUM_RUN))?,
                gradient: self.context.buffer("image gradient", pixels)?,
            }),
        };
        recorder.write(&fields.photograph, photograph);
        let samples = (3 * pixels) as f64;
        let uniform = recorder.uniform(&[ImageUniform {
            size: [size[0], size[1], 0, 0],
            weights: [((1.0 - SSIM_WEIGHT) / samples) as f32, (SSIM_WEIGHT / samples) as f32, 0.0, 0.0],
        }])?;
        let [width, height] = size.map(|side| side as usize);
        let row_groups = (height * width.div_ceil(WINDOW_RUN)).div_ceil(64) as u32;
        let column_groups = (width * height.div_ceil(WINDOW_RUN)).div_ceil(64) as u32;
        let (uniform, render) = (uniform.as_ref(), render.as_ref());
        let photograph = fields.photograph.as_ref();
        recorder.dispatch(
            &self.kernels.rows,
            &[uniform, render, photograph, fields.moments.as_ref()],
            row_groups,
        );
        recorder.dispatch(
            &self.kernels.columns,
            &[
                uniform,
                render,
                photograph,
                fields.moments.as_ref(),
                fields.derivatives.as_ref(),
                fields.losses.as_ref(),
            ],
            column_groups,
        );
        recorder.dispatch(
            &self.kernels.gradient_rows,
            &[uniform, fields.derivatives.as_ref(), fields.blurred.as_ref()],
            row_groups,
        );
        recorder.dispatch(
            &self.kernels.gradient,
            &[uniform, render, photograph, fields.blurred.as_ref(), fields.gradient.as_ref()],
            column_groups,
        );
        if let Some(weights) = wavelet {
            let constraint = ConstraintUniform::new(fields.size, weights);
            let groups = constraint.size[3].div_ceil(64);
            let constraint = recorder.uniform(&[constraint])?;
            recorder.dispatch(
                &self.kernels.wavelet,
                &[constraint.as_ref(), render, photograph, fields.losses.as_ref(), fields.gradient.as_ref()],
                groups,
            );
        }
        recorder.dispatch(
            &self.kernels.sums,
            &[uniform, fields.losses.as_ref(), fields.sums.as_ref()],
            pixels.div_ceil(SUM_RUN) as u32,
        );
        Ok(&fields.gradient)
    }

    /// The figures of the last submitted loss. Waits for the device.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn sums(&self) -> Result<Option<LossSums>, GpuError> {
        let Some(fields) = &self.fields else { return Ok(None) };
        let sums = self.context.read(&fields.sums)?;
        let samples = 3.0 * f64::from(fields.size[0]) * f64::from(fields.size[1]);
        let sum = |part: usize| sums.iter().map(|run| f64::from(run[part])).sum::<f64>();
        let mean = |part: usize| sum(part) / samples;
        Ok(Some(LossSums { ssim: mean(0), l1: mean(1), mse: mean(2), wavelet: sum(3) }))
    }
}

/// An RGB image as the kernels read it: one word a pixel, red lowest.
#[must_use]
pub(super) fn pack(rgb: &[u8]) -> Vec<u32> {
    rgb.chunks_exact(3).map(|p| u32::from_le_bytes([p[0], p[1], p[2], 255])).collect()
}
