//! Times of a training step's stages as shares of the adapter's peak rates: `cargo bench --bench kernels`.
//!
//! Arguments choose numbers of Gaussians and sides of images, such as `-- 10000 128`, or name pairs of any size, such as
//! `-- 1000000x1080`; `detail` lists single kernels;
//! `context` times the context model instead.
//! `TCGS_ADAPTER` chooses the adapter. Each figure is the minimum of several runs, which other load disturbs
//! least. `share` is the larger of bytes against the copy's rate and operations against the arithmetic's.
//!
//! The rasterizer works on a shell of as many Gaussians as stated; the networks on a tenth as many anchors, ten offsets
//! each, all visible; Adam on the anchors' rows. A step is all of it in one submission with nothing read back, in wall
//! time; a plain step is one of as many plain Gaussians with spherical harmonics of degree 3. The checksums below a table change only if a kernel computes something else.

#![allow(clippy::unwrap_used, reason = "a benchmark stops at the first fault")]

mod ceilings;
mod context;
mod plain;
mod scene;
mod work;

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::{Camera, SceneScale},
    gpu::{AdapterChoice, Buffer, Device, GpuError, KernelTime, Recorder},
    model::NetworkLayout,
    render::{
        AnchorGradients, DeviceAnchors, GaussianGradients, Gaussians, NeuralGaussians, RasterCounts,
        RasterSettings, Rasterizer, RenderError,
    },
    train::{Adam, AdamStep, ImageLoss, Moments, TrainError, WaveletWeights},
};

use ceilings::Ceilings;
use scene::SHAPE;
use work::{Size, Work};

const RUNS: usize = 20;
const GAUSSIANS: [usize; 3] = [10_000, 50_000, 200_000];
const SIDES: [u32; 3] = [128, 256, 512];

/// The stages in the order of a step.
const STAGES: [&str; 8] =
    ["networks forward", "project", "sort", "forward", "loss", "backward", "networks backward", "adam"];

/// Minimum time of each part.
type Times = BTreeMap<&'static str, Duration>;

/// The stage of a kernel of the rasterizer; everything between projection and blending is sorting and listing.
fn raster_stage(kernel: &str) -> &'static str {
    match kernel {
        "project" => "project",
        "raster_forward" => "forward",
        "raster_backward" | "gather" | "clear_culled" | "project_backward" => "backward",
        _ => "sort",
    }
}

fn add(times: &mut Times, name: &'static str, time: Duration) {
    *times.entry(name).or_default() += time;
}

fn keep_least(least: &mut Times, run: Times) {
    for (name, time) in run {
        least.entry(name).and_modify(|best| *best = time.min(*best)).or_insert(time);
    }
}

struct Bench {
    device: Arc<Device>,
    camera: Camera,
    gaussians: Gaussians,
    d_gaussians: GaussianGradients,
    rasterizer: Rasterizer,
    anchors: DeviceAnchors,
    d_anchors: AnchorGradients,
    neural: NeuralGaussians,
    loss: ImageLoss,
    photograph: Buffer<u32>,
    adam: Adam,
    rates: Buffer<f32>,
    moments: Moments,
    /// Never set: every step counts.
    overflow_flag: Buffer<u32>,
}

impl Bench {
    fn new(device: &Arc<Device>, count: usize, side: u32) -> Result<Self, RenderError> {
        let mut rng = Pcg64::seed_from_u64(2);
        let rows = scene::anchors(&mut rng, count / 10);
        let anchors = DeviceAnchors::upload(device, &rows, &NetworkLayout::new(SHAPE).initial(&mut rng))?;
        let rates: Vec<f32> = (1..=SHAPE.row()).map(|i| 1e-9 * i as f32).collect();
        let mut neural = NeuralGaussians::new(Arc::clone(device), SHAPE, 0.01, SceneScale::DEFAULT)?;
        // Gradients before the first backward pass; a spawned Gaussian's are as good as any.
        let camera = scene::camera(side);
        let mut recorder = device.recorder("first forward");
        neural.forward(&mut recorder, &anchors, &camera, 0.01)?;
        recorder.submit()?;
        let gradients = neural.gaussian_gradients()?;
        for buffer in [&gradients.geometry, &gradients.colors] {
            let values: Vec<[f32; 4]> =
                (0..buffer.len()).map(|_| [0; 4].map(|_| rng.random_range(-1.0..1.0))).collect();
            device.write(buffer, &values);
        }
        Ok(Self {
            camera,
            gaussians: scene::shell(device, count),
            d_gaussians: GaussianGradients::plan(count).make(device)?,
            rasterizer: Rasterizer::new(Arc::clone(device), RasterSettings::default())?,
            d_anchors: AnchorGradients::plan(SHAPE, anchors.count).make(device)?,
            neural,
            loss: ImageLoss::new(Arc::clone(device))?,
            photograph: device
                .upload("photograph", &(0..side * side).map(|_| rng.random()).collect::<Vec<u32>>())?,
            adam: Adam::new(device)?,
            rates: device.upload("rates", &rates)?,
            overflow_flag: device.upload("overflow flag", &[0])?,
            moments: Moments::plan(rows.values.len()).make(device)?,
            anchors,
            device: Arc::clone(device),
        })
    }

    fn record_networks_forward(&mut self, recorder: &mut Recorder<'_>) -> Result<(), RenderError> {
        self.neural.forward(recorder, &self.anchors, &self.camera, 0.01)
    }

    fn record_raster_forward(&mut self, recorder: &mut Recorder<'_>) -> Result<(), RenderError> {
        self.rasterizer.forward(recorder, &self.gaussians, &self.camera, [0.0; 3])
    }

    fn record_loss(&mut self, recorder: &mut Recorder<'_>) -> Result<Buffer<[f32; 4]>, GpuError> {
        let k = &self.camera.intrinsics;
        let size = [k.width, k.height];
        let image = self.rasterizer.image();
        Ok(self.loss.record(recorder, size, image, &self.photograph, Some(&WaveletWeights::at(0.5)))?.clone())
    }

    fn record_raster_backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        d_image: &Buffer<[f32; 4]>,
    ) -> Result<(), RenderError> {
        self.rasterizer.backward(recorder, &self.gaussians, &self.camera, d_image, &self.d_gaussians)
    }

    fn record_networks_backward(&mut self, recorder: &mut Recorder<'_>) -> Result<(), RenderError> {
        self.neural.backward(recorder, &self.anchors, &self.d_anchors)
    }

    fn record_adam(&self, recorder: &mut Recorder<'_>) -> Result<(), GpuError> {
        let (gradients, values) = (&self.d_anchors.rows, &self.anchors.rows);
        let step = AdamStep { number: 1, overflow_flag: &self.overflow_flag };
        self.adam.step(recorder, step, &self.rates, gradients, values, &self.moments)
    }

    /// Everything in one submission, in wall time.
    fn step(&mut self) -> Result<Duration, RenderError> {
        let device = Arc::clone(&self.device);
        let start = Instant::now();
        let mut recorder = device.recorder("step");
        self.record_networks_forward(&mut recorder)?;
        self.record_raster_forward(&mut recorder)?;
        let d_image = self.record_loss(&mut recorder)?;
        self.record_raster_backward(&mut recorder, &d_image)?;
        self.record_networks_backward(&mut recorder)?;
        self.record_adam(&mut recorder)?;
        recorder.submit()?;
        device.wait()?;
        Ok(start.elapsed())
    }

    /// The stages and the single kernels of a step, on the device.
    fn stages(&mut self) -> Result<(Times, Times), RenderError> {
        let device = Arc::clone(&self.device);
        let (mut stages, mut kernels) = (Times::new(), Times::new());
        let mut take = |stage: &dyn Fn(&str) -> &'static str, recorder: Recorder<'_>| {
            for KernelTime { name, time } in recorder.submit_timed()? {
                add(&mut stages, stage(name), time);
                add(&mut kernels, name, time);
            }
            Ok::<(), RenderError>(())
        };
        let mut recorder = device.timed_recorder("networks");
        self.record_networks_forward(&mut recorder)?;
        take(&|_| "networks forward", recorder)?;
        let mut recorder = device.timed_recorder("rasterizer");
        self.record_raster_forward(&mut recorder)?;
        take(&raster_stage, recorder)?;
        let mut recorder = device.timed_recorder("loss");
        let d_image = self.record_loss(&mut recorder)?;
        take(&|_| "loss", recorder)?;
        let mut recorder = device.timed_recorder("rasterizer");
        self.record_raster_backward(&mut recorder, &d_image)?;
        take(&raster_stage, recorder)?;
        let mut recorder = device.timed_recorder("networks");
        self.record_networks_backward(&mut recorder)?;
        take(&|_| "networks backward", recorder)?;
        let mut recorder = device.timed_recorder("adam");
        self.record_adam(&mut recorder)?;
        take(&|_| "adam", recorder)?;
        Ok((stages, kernels))
    }

    /// Renders until nothing overflows.
    fn counts(&mut self) -> Result<RasterCounts, RenderError> {
        loop {
            let device = Arc::clone(&self.device);
            let mut recorder = device.recorder("counts");
            self.record_raster_forward(&mut recorder)?;
            recorder.submit()?;
            let counts = self.rasterizer.counts()?;
            if !counts.overflowed {
                return Ok(counts);
            }
            self.rasterizer.grow(&counts)?;
        }
    }

    fn checksums(&self) -> Result<String, RenderError> {
        let flat = |buffer: &Buffer<[f32; 4]>| {
            Ok::<_, RenderError>(self.device.read(buffer)?.into_iter().flatten().collect::<Vec<f32>>())
        };
        Ok(format!(
            "image {:.6e}, by geometry {:.6e}, by colors {:.6e}, by rows {:.6e}, by networks {:.6e}",
            checksum(&flat(self.rasterizer.image())?),
            checksum(&flat(&self.d_gaussians.geometry)?),
            checksum(&flat(&self.d_gaussians.colors)?),
            checksum(&self.device.read(&self.d_anchors.rows)?),
            checksum(&self.device.read(&self.d_anchors.networks)?),
        ))
    }
}

/// A sum of magnitudes with a different weight for each position.
fn checksum(values: &[f32]) -> f64 {
    let weight = |i: usize| 1.0 + (i as f64 * 0.618_033_988_75).fract();
    values.iter().enumerate().map(|(i, v)| weight(i) * f64::from(v.abs())).sum()
}

fn print_row(name: &str, time: Duration, work: Work, ceilings: &Ceilings) {
    let seconds = time.as_secs_f64();
    let share = (work.bytes / ceilings.copy).max(work.flops / ceilings.arithmetic) / seconds;
    println!(
        "{name:>18} {:>9.2} {:>9.2} {:>9.1} {:>7.2} {:>8.2} {:>6.1}%",
        1e3 * seconds,
        1e-6 * work.bytes,
        1e-6 * work.flops,
        1e-9 * work.bytes / seconds,
        1e-9 * work.flops / seconds,
        100.0 * share
    );
}

fn table(
    device: &Arc<Device>,
    ceilings: &Ceilings,
    count: usize,
    side: u32,
    detail: bool,
) -> Result<(), RenderError> {
    let mut bench = Bench::new(device, count, side)?;
    let size = Size {
        gaussians: count,
        anchors: bench.anchors.count,
        parameters: bench.anchors.rows.len(),
        side,
        counts: bench.counts()?,
    };
    let (mut stages, mut kernels, mut step) = (Times::new(), Times::new(), Duration::MAX);
    for _ in 0..RUNS {
        step = step.min(bench.step()?);
        let (run_stages, run_kernels) = bench.stages()?;
        keep_least(&mut stages, run_stages);
        keep_least(&mut kernels, run_kernels);
    }
    println!(
        "\n{count} Gaussians, {side} x {side}: {} visible, {:.2} tiles each; {} anchors",
        size.counts.visible,
        f64::from(size.counts.intersections) / f64::from(size.counts.visible.max(1)),
        size.anchors
    );
    println!(
        "{:>18} {:>9} {:>9} {:>9} {:>7} {:>8} {:>7}",
        "stage", "ms", "MB", "MFLOP", "GB/s", "GFLOP/s", "share"
    );
    let mut all = Work::default();
    for stage in STAGES {
        let work = size.work(stage);
        all.bytes += work.bytes;
        all.flops += work.flops;
        print_row(stage, stages.get(stage).copied().unwrap_or_default(), work, ceilings);
    }
    print_row("step", step, all, ceilings);
    let plain = plain::step(device, count, side, RUNS)?;
    let ms = |time: Duration| 1e3 * time.as_secs_f64();
    let (wall, device_time) = (plain.wall, plain.kernels.values().sum::<Duration>());
    println!("{:>18} {:>9.2} {:>42.1} steps/s", "plain step", ms(wall), 1.0 / wall.as_secs_f64());
    println!(
        "{:>18} {:>9.2} on the device, {:.2} recording and submitting",
        "of it",
        ms(device_time),
        ms(plain.host)
    );
    if detail {
        for (step, kernels) in [("step", kernels), ("plain step", plain.kernels)] {
            println!("{step:>18}, its kernels");
            for (name, time) in kernels {
                println!("{name:>40} {:>8.3}", ms(time));
            }
        }
    }
    println!("checksums: {}", bench.checksums()?);
    Ok(())
}

/// A number of Gaussians and a side, as in `1000000x1080`.
fn size(text: &str) -> Option<(usize, u32)> {
    let (count, side) = text.split_once('x')?;
    Some((count.parse().ok()?, side.parse().ok()?))
}

fn main() -> Result<(), TrainError> {
    let wanted: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let numbers: Vec<usize> = wanted.iter().filter_map(|text| text.parse().ok()).collect();
    let asked = |number: usize, of: &[usize]| {
        let chosen: Vec<_> = numbers.iter().filter(|n| of.contains(n)).collect();
        chosen.is_empty() || chosen.contains(&&number)
    };
    let choice: AdapterChoice =
        std::env::var("TCGS_ADAPTER").unwrap_or_else(|_| "lavapipe".to_owned()).parse().unwrap();
    let device = Device::new(&choice)?;
    println!("adapter: {}", device.adapter_line());
    let detail = wanted.iter().any(|a| a == "detail");
    if wanted.iter().any(|a| a == "context") {
        return context::table(&device, RUNS, detail);
    }
    let ceilings = Ceilings::measure(&device);
    println!(
        "ceilings: copy {:.1} GB/s, random reads {:.2} GB/s, arithmetic {:.1} GFLOP/s; least of {RUNS} runs",
        1e-9 * ceilings.copy,
        1e-9 * ceilings.gather,
        1e-9 * ceilings.arithmetic
    );
    let mut sizes: Vec<(usize, u32)> = wanted.iter().filter_map(|text| size(text)).collect();
    if sizes.is_empty() {
        let sides = SIDES.into_iter().filter(|side| asked(*side as usize, &SIDES.map(|side| side as usize)));
        let sides: Vec<u32> = sides.collect();
        let counts = GAUSSIANS.into_iter().filter(|count| asked(*count, &GAUSSIANS));
        sizes = counts.flat_map(|count| sides.iter().map(move |side| (count, *side))).collect();
    }
    for (count, side) in sizes {
        table(&device, &ceilings, count, side, detail)?;
    }
    Ok(())
}
