//! The image loss on the device: 0.8 L1 + 0.2 (1 - SSIM) (METHOD.md §2.4) and, where asked for, the wavelet constraint;
//! with its gradient.
//!
//! Software adapters go along rows and columns in long runs, with the window's first half in memory. Hardware gives each workgroup
//! a tile, whose two halves of the window stay in workgroup memory; the derivatives of SSIM are the only field in memory.

use std::sync::Arc;

use super::WaveletWeights;
use crate::gpu::{
    AdapterReport, Binding, Buffer, Device, GpuError, Kernel, KernelVariant, Plan, Recorder, buffer_bytes,
    kernel_source, planned,
};

/// Weight of the SSIM part; L1 has the rest.
const SSIM_WEIGHT: f64 = 0.2;

/// Shares that one partial sum covers on software adapters and on hardware, as in `shaders/loss/sum_losses.wgsl`.
const SUM_RUN: [usize; 2] = [4096, 512];

/// Columns in a block of a field, and what its rows are a multiple of, as in `shaders/shared/ssim.wgsl`.
const BLOCK: usize = 8;
const STRIDE: usize = 4;

/// Pixels in line that an invocation of the software's kernels makes. It reads up to ten pixels before and after them, so long runs
/// repeat less work.
const RUN: u32 = 256;

/// Side of a tile of the hardware's kernels, as in `shaders/shared/ssim_tile.wgsl`.
const TILE: u32 = 16;

/// Derivatives of SSIM that the hardware's kernels store for a sample.
const DERIVATIVES: usize = 3;

/// Channels of an image.
const CHANNELS: u32 = 3;

#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ImageUniform {
    size: [u32; 4],
    weights: [f32; 4],
    channels: [u32; 4],
}

#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ConstraintUniform {
    size: [u32; 4],
    places: [u32; 4],
    fine: [f32; 4],
    coarse: [f32; 4],
}

impl ConstraintUniform {
    /// Every weight divided by the samples of its band.
    fn new([width, height]: [u32; 2], first_share: u32, weights: &WaveletWeights) -> Self {
        let halves = [width.div_ceil(2), height.div_ceil(2)];
        let quarters = [width.div_ceil(4), height.div_ceil(4)];
        let share = |[across, down]: [u32; 2], low: f64, [lh, hl, hh]: [f64; 3]| {
            let samples = 3.0 * f64::from(across) * f64::from(down);
            [low, lh, hl, hh].map(|weight| (weight / samples) as f32)
        };
        Self {
            size: [width, height, quarters[0], quarters[0] * quarters[1]],
            places: [first_share, 0, 0, 0],
            fine: share(halves, 0.0, weights.fine),
            coarse: share(quarters, weights.low, weights.coarse),
        }
    }
}

#[derive(Debug)]
struct Kernels {
    image: ImageKernels,
    wavelet: Arc<Kernel>,
    sums: Arc<Kernel>,
}

/// The definitions of kernels for photographs of which some pixels do not count, or for those of which all do.
fn definitions(masked: bool) -> &'static [(&'static str, u32)] {
    if masked { &[("MASKED", 1)] } else { &[] }
}

/// The kernels of L1, SSIM and their gradient.
#[derive(Debug)]
enum ImageKernels {
    Software { rows: Arc<Kernel>, columns: Arc<Kernel>, gradient: Arc<Kernel>, masked: bool },
    Hardware { tiles: Arc<Kernel>, gradient: Arc<Kernel> },
}

impl ImageKernels {
    fn new(device: &Device, masked: bool) -> Result<Self, GpuError> {
        let kernel = |source| device.kernel(source, definitions(masked));
        Ok(match device.variant() {
            KernelVariant::Software => Self::Software {
                rows: kernel(kernel_source!("ssim_rows"))?,
                columns: kernel(kernel_source!("ssim_columns"))?,
                gradient: kernel(kernel_source!("image_gradient"))?,
                masked,
            },
            KernelVariant::Hardware => Self::Hardware {
                tiles: kernel(kernel_source!("ssim_tiles"))?,
                gradient: kernel(kernel_source!("image_gradient_tiles"))?,
            },
        })
    }

    /// Records the losses and the gradient of the channels that `uniform` names.
    fn record(
        &self,
        recorder: &mut Recorder<'_>,
        uniform: &Buffer<ImageUniform>,
        [render, photograph]: [Binding<'_>; 2],
        fields: &Fields,
    ) {
        let Fields { division, moments, derivatives, losses, gradient: d_image, .. } = fields;
        match self {
            Self::Software { rows, columns, gradient, masked } => {
                let [by_rows, by_columns] = [division.by_rows(), division.by_columns()]
                    .map(|invocations| (division.channels * invocations).div_ceil(64));
                recorder.dispatch(rows, &[uniform, render, photograph, moments], by_rows);
                let of_columns: [Binding<'_>; 5] = [uniform, moments, derivatives, losses, photograph];
                // Where all pixels count, the kernel does not bind the photograph.
                let bound = if *masked { of_columns.len() } else { of_columns.len() - 1 };
                recorder.dispatch(columns, &of_columns[..bound], by_columns);
                recorder.dispatch(
                    gradient,
                    &[uniform, render, photograph, derivatives, losses, d_image],
                    by_rows,
                );
            }
            Self::Hardware { tiles, gradient } => {
                let groups = division.channels * division.tiles();
                recorder.dispatch(tiles, &[uniform, render, photograph, derivatives, losses], groups);
                recorder.dispatch(gradient, &[uniform, render, photograph, derivatives, d_image], groups);
            }
        }
    }
}

/// How an image is divided among invocations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Division {
    size: [u32; 2],
    variant: KernelVariant,
    /// Pixels in line that an invocation of the software's kernels makes; a multiple of `STRIDE`.
    run: u32,
    /// Channels at a time.
    channels: u32,
}

impl Division {
    /// All channels at a time where the adapter binds their fields, or else one, whose bits do not depend on the others.
    fn of(size: [u32; 2], run: u32, adapter: &AdapterReport) -> Self {
        let whole = Self { size, variant: adapter.variant, run, channels: CHANNELS };
        let fits = buffer_bytes::<[f32; 4]>(whole.derivatives()) <= binding_limit(adapter);
        if fits { whole } else { Self { channels: 1, ..whole } }
    }

    /// Invocations that go along the rows of a channel.
    fn by_rows(self) -> u32 {
        self.size[1] * self.size[0].div_ceil(self.run)
    }

    /// Invocations that go along the columns of a channel.
    fn by_columns(self) -> u32 {
        self.size[0] * self.size[1].div_ceil(self.run)
    }

    /// Blocks of the wavelet constraint.
    fn blocks(self) -> u32 {
        self.size[0].div_ceil(4) * self.size[1].div_ceil(4)
    }

    /// Tiles of the hardware's kernels.
    fn tiles(self) -> u32 {
        self.size[0].div_ceil(TILE) * self.size[1].div_ceil(TILE)
    }

    /// Shares of the losses that are always there: one for each invocation, or for each tile.
    fn shares(self) -> u32 {
        CHANNELS * self.variant.choose(self.by_columns() + self.by_rows(), self.tiles())
    }

    fn max_shares(self) -> usize {
        (self.shares() + self.blocks()) as usize
    }

    /// Partial sums of the losses.
    fn sums(self) -> usize {
        let [software, hardware] = SUM_RUN;
        self.max_shares().div_ceil(self.variant.choose(software, hardware))
    }

    fn pixels(self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }

    /// Elements of the moments' sums along rows.
    fn moments(self) -> usize {
        let [width, height] = self.size.map(|side| side as usize);
        let padded = width.next_multiple_of(BLOCK) * height.next_multiple_of(STRIDE);
        self.variant.choose(self.channels as usize * padded, 0)
    }

    /// Elements of the derivatives of SSIM.
    fn derivatives(self) -> usize {
        let values = DERIVATIVES * self.channels as usize * self.pixels();
        self.variant.choose(self.moments(), values.div_ceil(4))
    }
}

/// Bytes of the largest buffer that kernels can be given.
pub(super) fn binding_limit(adapter: &AdapterReport) -> u64 {
    adapter.max_binding_bytes.min(adapter.max_buffer_bytes)
}

/// Buffers of the last images; those of smaller images have room to spare.
#[derive(Debug)]
struct Fields {
    division: Division,
    moments: Buffer<[f32; 4]>,
    derivatives: Buffer<[f32; 4]>,
    losses: Buffer<[f32; 4]>,
    sums: Buffer<[f32; 4]>,
    gradient: Buffer<[f32; 4]>,
}

impl Fields {
    /// Plans the buffers of images of one size; those of `old` with enough memory are kept.
    fn plan(division: Division, old: Option<&Self>) -> Plan<'_, Self> {
        let (moments, derivatives) = (division.moments(), division.derivatives());
        planned!(Self {
            division: Plan::value(division),
            moments: Plan::resized("SSIM moments", moments, old.map(|old| &old.moments)),
            derivatives: Plan::resized("SSIM derivatives", derivatives, old.map(|old| &old.derivatives)),
            losses: Plan::resized("losses", division.max_shares(), old.map(|old| &old.losses)),
            sums: Plan::resized("loss sums", division.sums(), old.map(|old| &old.sums)),
            gradient: Plan::resized("image gradient", division.pixels(), old.map(|old| &old.gradient)),
        })
    }
}

/// The difference of render and photograph: means over all samples of an image that count.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossSums {
    /// Mean SSIM.
    pub ssim: f64,
    /// Mean absolute difference.
    pub l1: f64,
    /// Mean squared difference.
    pub mse: f64,
    /// The weighted wavelet constraint; 0 without it.
    pub wavelet: f64,
}

impl LossSums {
    /// 0.8 L1 + 0.2 (1 - SSIM), and the wavelet constraint.
    #[must_use]
    pub fn loss(&self) -> f64 {
        (1.0 - SSIM_WEIGHT) * self.l1 + SSIM_WEIGHT * (1.0 - self.ssim) + self.wavelet
    }

    /// PSNR of the unquantized render in dB, at most 100.
    #[must_use]
    pub fn psnr(&self) -> f64 {
        -10.0 * self.mse.max(1e-10).log10()
    }
}

/// Partial sums of a loss on the device.
#[derive(Debug, Clone)]
pub struct PartialSums {
    /// Sums over some pixels each: of SSIM, absolute and squared differences, and of the weighted wavelet constraint.
    pub sums: Buffer<[f32; 4]>,
    /// Samples of the image.
    samples: usize,
    /// How many of them count.
    counted: usize,
}

impl PartialSums {
    /// The values of the loss from a copy of [`Self::sums`].
    #[must_use]
    pub fn total(&self, sums: &[[f32; 4]]) -> LossSums {
        let sum =
            |part: usize| sums.iter().take(self.sums.len()).map(|run| f64::from(run[part])).sum::<f64>();
        // A photograph of which nothing counts has no loss.
        let counted = self.counted.max(1) as f64;
        let mean = |part: usize| sum(part) / counted;
        let ssim = if self.counted == 0 { 1.0 } else { mean(0) };
        LossSums { ssim, l1: mean(1), mse: mean(2), wavelet: sum(3) * (self.samples as f64 / counted) }
    }
}

/// Compares renders with photographs.
#[derive(Debug)]
pub struct ImageLoss {
    device: Arc<Device>,
    kernels: Kernels,
    run: u32,
    fields: Option<Fields>,
    /// Pixels of the last image that count.
    counted: usize,
}

impl ImageLoss {
    /// Prepares the kernels.
    pub fn new(device: Arc<Device>) -> Result<Self, GpuError> {
        Self::with_run(device, RUN)
    }

    /// As [`ImageLoss::new`], for photographs of which some pixels do not count.
    pub fn masked(device: Arc<Device>) -> Result<Self, GpuError> {
        Self::with(device, RUN, true)
    }

    /// As [`ImageLoss::masked`], with invocations as those of [`ImageLoss::with_run`].
    pub fn masked_with_run(device: Arc<Device>, run: u32) -> Result<Self, GpuError> {
        Self::with(device, run, true)
    }

    /// As [`ImageLoss::new`], with invocations of the software's kernels that make `run` pixels in line, a multiple of 4.
    pub fn with_run(device: Arc<Device>, run: u32) -> Result<Self, GpuError> {
        Self::with(device, run, false)
    }

    fn with(device: Arc<Device>, run: u32, masked: bool) -> Result<Self, GpuError> {
        let kernels = Kernels {
            image: ImageKernels::new(&device, masked)?,
            wavelet: device.kernel(kernel_source!("wavelet"), definitions(masked))?,
            sums: device.kernel(kernel_source!("sum_losses"), &[])?,
        };
        Ok(Self { device, kernels, run, fields: None, counted: 0 })
    }

    /// Bytes on the device once images of up to `size` were compared, at most.
    #[must_use]
    pub fn bytes(adapter: &AdapterReport, size: [u32; 2]) -> u64 {
        let division = Division::of(size, RUN, adapter);
        let fields = Fields::plan(division, None).bytes();
        // Smaller images whose channels go at once may have larger fields.
        let large = adapter.variant.choose(2, 1) * binding_limit(adapter);
        let smaller = if division.channels < CHANNELS { large } else { 0 };
        buffer_bytes::<ImageUniform>(1) + buffer_bytes::<ConstraintUniform>(1) + fields.max(smaller)
    }

    /// Bytes of the largest buffer that images of `size` need; the render's own has as many for each pixel as the gradient.
    pub(super) fn largest_buffer_bytes(adapter: &AdapterReport, size: [u32; 2]) -> u64 {
        let division = Division::of(size, RUN, adapter);
        let elements = [division.pixels(), division.moments(), division.derivatives(), division.max_shares()];
        elements.into_iter().map(buffer_bytes::<[f32; 4]>).fold(0, u64::max)
    }

    /// Records the loss of `render` against `photograph` (packed 8-bit RGB, one word a pixel, red lowest) and its gradient; without
    /// `wavelet` the constraint costs nothing. All pixels count.
    pub fn record(
        &mut self,
        recorder: &mut Recorder<'_>,
        size: [u32; 2],
        render: &Buffer<[f32; 4]>,
        photograph: &Buffer<u32>,
        wavelet: Option<&WaveletWeights>,
    ) -> Result<&Buffer<[f32; 4]>, GpuError> {
        let pixels = size[0] as usize * size[1] as usize;
        self.record_counted(recorder, size, render, (photograph, pixels), wavelet)
    }

    /// As [`ImageLoss::record`], where the fourth byte of a pixel's word is its weight, 255 or 0, as [`ImageLoss::masked`] reads it, and
    /// so many pixels have 255. The others are as pixels outside the image: zero in both, without gradient. The gradient is that of the
    /// sums divided by all samples, so that a pixel weighs the same in every photograph.
    pub fn record_counted(
        &mut self,
        recorder: &mut Recorder<'_>,
        size: [u32; 2],
        render: &Buffer<[f32; 4]>,
        (photograph, counted): (&Buffer<u32>, usize),
        wavelet: Option<&WaveletWeights>,
    ) -> Result<&Buffer<[f32; 4]>, GpuError> {
        self.counted = counted;
        let division = Division::of(size, self.run, self.device.adapter());
        let fields = Fields::plan(division, self.fields.as_ref()).make(&self.device)?;
        let fields = &*self.fields.insert(fields);
        let samples = (3 * division.pixels()) as f64;
        let blocks = if wavelet.is_some() { division.blocks() } else { 0 };
        let uniform = |first| {
            recorder.uniform(&[ImageUniform {
                size: [size[0], size[1], division.run, division.shares() + blocks],
                weights: [((1.0 - SSIM_WEIGHT) / samples) as f32, (SSIM_WEIGHT / samples) as f32, 0.0, 0.0],
                channels: [first, division.channels, 0, 0],
            }])
        };
        let first_channels = (0..CHANNELS).step_by(division.channels as usize);
        let uniforms = first_channels.map(uniform).collect::<Result<Vec<_>, _>>()?;
        for uniform in &uniforms {
            self.kernels.image.record(recorder, uniform, [render, photograph], fields);
        }
        if let Some(weights) = wavelet {
            let constraint = recorder.uniform(&[ConstraintUniform::new(size, division.shares(), weights)])?;
            recorder.dispatch(
                &self.kernels.wavelet,
                &[&constraint, render, photograph, &fields.losses, &fields.gradient],
                blocks.div_ceil(64),
            );
        }
        recorder.dispatch(
            &self.kernels.sums,
            &[&uniforms[0], &fields.losses, &fields.sums],
            fields.sums.len() as u32,
        );
        Ok(&fields.gradient)
    }

    /// The values of the last submitted loss. Waits for the device.
    pub fn sums(&self) -> Result<Option<LossSums>, GpuError> {
        let Some(partial) = self.partial_sums() else { return Ok(None) };
        Ok(Some(partial.total(&self.device.read(&partial.sums)?)))
    }

    /// Where the values of the last recorded loss are.
    #[must_use]
    pub fn partial_sums(&self) -> Option<PartialSums> {
        let fields = self.fields.as_ref()?;
        let (samples, counted) = (3 * fields.division.pixels(), 3 * self.counted);
        Some(PartialSums { sums: fields.sums.clone(), samples, counted })
    }
}
