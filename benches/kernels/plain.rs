//! A whole step of plain Gaussians with spherical harmonics of degree 3: what `model=3dgs` does a photograph.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::Camera,
    gpu::{Buffer, Device, KernelTime, Recorder},
    model::GaussianRows,
    render::{DeviceGaussians, PlainGaussians, RasterSettings, Rasterizer, RenderError},
    train::{Adam, AdamStep, ImageLoss, Moments},
};

use super::{Times, add, keep_least, scene};

/// Least times of a step.
#[derive(Debug)]
pub(crate) struct PlainStep {
    /// From the first dispatch that is recorded to the end on the device, nothing read back.
    pub(crate) wall: Duration,
    /// Of the host until it waits: recording and submitting.
    pub(crate) host: Duration,
    /// Of each kernel on the device.
    pub(crate) kernels: Times,
}

struct Bench {
    camera: Camera,
    rows: DeviceGaussians,
    gradients: DeviceGaussians,
    moments: [Moments; 2],
    plain: PlainGaussians,
    rasterizer: Rasterizer,
    loss: ImageLoss,
    adam: Adam,
    photograph: Buffer<u32>,
    rates: Buffer<f32>,
    overflow_flag: Buffer<u32>,
}

impl Bench {
    fn new(device: &Arc<Device>, count: usize, side: u32) -> Result<Self, RenderError> {
        let mut rng = Pcg64::seed_from_u64(3);
        let values = rows(&scene::shell(device, count), device, &mut rng)?;
        let bands: usize = values.bands.iter().map(Vec::len).sum();
        let mut plain = PlainGaussians::new(Arc::clone(device), RasterSettings::default().near)?;
        plain.set_degree(3)?;
        let photograph: Vec<u32> = (0..side * side).map(|_| rng.random()).collect();
        Ok(Self {
            camera: scene::camera(side),
            rows: DeviceGaussians::upload(device, &values)?,
            gradients: DeviceGaussians::upload(device, &GaussianRows::zero(count))?,
            moments: [Moments::plan(values.base.len()).make(device)?, Moments::plan(bands).make(device)?],
            plain,
            rasterizer: Rasterizer::new(Arc::clone(device), RasterSettings::default())?,
            loss: ImageLoss::new(Arc::clone(device))?,
            adam: Adam::new(device)?,
            photograph: device.upload("photograph", &photograph)?,
            // So small that the scene stays as it is.
            rates: device.upload("rates", &[1e-9_f32])?,
            overflow_flag: device.upload("overflow flag", &[0_u32])?,
        })
    }

    fn record(&mut self, recorder: &mut Recorder<'_>) -> Result<(), RenderError> {
        let size = [self.camera.intrinsics.width, self.camera.intrinsics.height];
        self.plain.forward(recorder, &self.rows, &self.camera)?;
        self.rasterizer.forward(recorder, self.plain.gaussians(), &self.camera, [0.0; 3])?;
        let image = self.rasterizer.image();
        let d_image = self.loss.record(recorder, size, image, &self.photograph, None)?.clone();
        let d_gaussians = self.plain.gaussian_gradients()?.clone();
        self.rasterizer.backward(recorder, self.plain.gaussians(), &self.camera, &d_image, &d_gaussians)?;
        self.plain.backward(recorder, &self.rows, &self.gradients)?;
        let step = AdamStep { number: 1, overflow_flag: &self.overflow_flag };
        let [base, bands] = &self.moments;
        let (rows, gradients) = (&self.rows, &self.gradients);
        self.adam.step(recorder, step, &self.rates, &gradients.base, &rows.base, base)?;
        Ok(self.adam.step(recorder, step, &self.rates, &gradients.bands, &rows.bands, bands)?)
    }
}

/// Least times of `runs` steps.
pub(crate) fn step(
    device: &Arc<Device>,
    count: usize,
    side: u32,
    runs: usize,
) -> Result<PlainStep, RenderError> {
    let mut bench = Bench::new(device, count, side)?;
    let mut least = PlainStep { wall: Duration::MAX, host: Duration::MAX, kernels: Times::new() };
    for run in 0..=runs {
        let start = Instant::now();
        let mut recorder = device.recorder("step of plain Gaussians");
        bench.record(&mut recorder)?;
        recorder.submit()?;
        let host = start.elapsed();
        device.wait()?;
        // The first run makes buffers and kernels.
        if run > 0 {
            least.wall = least.wall.min(start.elapsed());
            least.host = least.host.min(host);
            let mut recorder = device.timed_recorder("step of plain Gaussians");
            bench.record(&mut recorder)?;
            let mut kernels = Times::new();
            for KernelTime { name, time } in recorder.submit_timed()? {
                add(&mut kernels, name, time);
            }
            keep_least(&mut least.kernels, kernels);
        }
        let counts = bench.rasterizer.counts()?;
        if counts.overflowed {
            bench.rasterizer.grow(&counts)?;
            least = PlainStep { wall: Duration::MAX, host: Duration::MAX, kernels: Times::new() };
        }
    }
    Ok(least)
}

/// The rows of a shell's Gaussians, with small coefficients.
fn rows(
    shell: &tcgs::render::Gaussians,
    device: &Device,
    rng: &mut Pcg64,
) -> Result<GaussianRows, RenderError> {
    let mut rows = GaussianRows::zero(shell.capacity);
    let (geometry, colors) = (device.read(&shell.geometry)?, device.read(&shell.colors)?);
    let (means, rest) = geometry.split_at(shell.capacity);
    let (scales, quats) = rest.split_at(shell.capacity);
    for (i, row) in rows.base.chunks_exact_mut(tcgs::model::gaussian_rows::BASE).enumerate() {
        let opacity = means[i][3].min(0.99);
        row[..3].copy_from_slice(&means[i][..3]);
        row[3..6].copy_from_slice(&[0, 1, 2].map(|axis| scales[i][axis].ln()));
        row[6..10].copy_from_slice(&quats[i]);
        row[10] = (opacity / (1.0 - opacity)).ln();
        row[11..14].copy_from_slice(&colors[i][..3]);
    }
    for band in &mut rows.bands {
        band.fill_with(|| rng.random_range(-0.1..0.1));
    }
    Ok(rows)
}
