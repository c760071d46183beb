//! Times of the rasteriser's stages: `cargo bench --bench raster`. `TCGS_ADAPTER` chooses the adapter, an argument
//! `kernels` lists single kernels. Each figure is the least of several runs, which load on the machine disturbs least.

#![allow(clippy::unwrap_used, reason = "a benchmark stops at the first fault")]

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::{Camera, Intrinsics, Pose},
    gpu::{AdapterChoice, Buffer, Context, KernelTime, Pairs, RadixSort},
    render::{Counts, GaussianGradients, Gaussians, RasterSettings, Rasterizer},
};

const RUNS: usize = 15;

/// What the stages are called, and which kernels belong to each; everything else is sorting and listing.
const STAGES: [(&str, &[&str]); 3] = [
    ("project", &["project"]),
    ("forward", &["raster_forward"]),
    ("backward", &["raster_backward", "gather", "project_backward"]),
];

fn scene(context: &Context, count: usize) -> Gaussians {
    let mut rng = Pcg64::seed_from_u64(1);
    // About as large as in a trained scene of this many.
    let size = 0.6 / (count as f32).sqrt();
    let mut rows = |low: f32, high: f32| -> Vec<[f32; 4]> {
        (0..count).map(|_| [0; 4].map(|_| rng.random_range(low..high))).collect()
    };
    let mut means = rows(-1.0, 1.0);
    for mean in &mut means {
        mean[3] = mean[3].abs();
    }
    Gaussians {
        count: context.upload("count", &[count as u32]).unwrap(),
        capacity: count,
        means_opacity: context.upload("means", &means).unwrap(),
        scales: context.upload("scales", &rows(0.3 * size, 3.0 * size)).unwrap(),
        quats: context.upload("quats", &rows(-1.0, 1.0)).unwrap(),
        colors: context.upload("colors", &rows(0.0, 1.0)).unwrap(),
    }
}

struct Bench {
    context: Arc<Context>,
    rasterizer: Rasterizer,
    gaussians: Gaussians,
    camera: Camera,
    v_image: Buffer<[f32; 4]>,
    out: GaussianGradients,
}

impl Bench {
    fn new(context: &Arc<Context>, count: usize, side: u32) -> Self {
        let pose = Pose::look_at(DVec3::new(3.5, 1.0, 1.5), DVec3::ZERO, DVec3::Z).unwrap();
        let camera = Camera::new(Intrinsics::from_horizontal_fov(0.7, side, side).unwrap(), pose).unwrap();
        let v_image = vec![[0.1, -0.2, 0.3, 0.1]; (side * side) as usize];
        Self {
            rasterizer: Rasterizer::new(Arc::clone(context), RasterSettings::default()).unwrap(),
            gaussians: scene(context, count),
            camera,
            v_image: context.upload("v_image", &v_image).unwrap(),
            out: GaussianGradients::new(context, count).unwrap(),
            context: Arc::clone(context),
        }
    }

    /// One forward and backward pass: what each kernel took, and all of it by the clock.
    fn run(&mut self, timed: bool) -> (Vec<KernelTime>, Duration) {
        let start = Instant::now();
        let context = Arc::clone(&self.context);
        let mut recorder = if timed { context.timed_recorder("run") } else { context.recorder("run") };
        self.rasterizer.forward(&mut recorder, &self.gaussians, &self.camera, [0.0; 3]).unwrap();
        self.rasterizer
            .backward(&mut recorder, &self.gaussians, &self.camera, &self.v_image, &self.out)
            .unwrap();
        let times = recorder.submit_timed().unwrap();
        (times, start.elapsed())
    }

    fn counts(&mut self) -> Counts {
        loop {
            self.run(false);
            let counts = self.rasterizer.counts().unwrap();
            if !counts.overflowed {
                return counts;
            }
            self.rasterizer.grow(&counts).unwrap();
        }
    }
}

/// Milliseconds of a sort of `count` pairs by 32-bit keys.
fn sort_time(context: &Context, count: usize) -> f64 {
    let mut rng = Pcg64::seed_from_u64(2);
    let keys: Vec<u32> = (0..count).map(|_| rng.random()).collect();
    let sort = RadixSort::new(context, count, 32, 0).unwrap();
    let counts = context.upload("counts", &[count as u32]).unwrap();
    let (pairs, spare) = (Pairs::new(context, count).unwrap(), Pairs::new(context, count).unwrap());
    let mut best = Duration::MAX;
    for _ in 0..RUNS {
        context.write(&pairs.keys, &keys);
        let mut recorder = context.timed_recorder("sort");
        let _ = sort.record(&mut recorder, &counts, &pairs, &spare);
        best = best.min(recorder.submit_timed().unwrap().iter().map(|kernel| kernel.time).sum());
    }
    1e3 * best.as_secs_f64()
}

fn main() {
    let detailed = std::env::args().any(|argument| argument == "kernels");
    let choice: AdapterChoice =
        std::env::var("TCGS_ADAPTER").unwrap_or_else(|_| "lavapipe".to_owned()).parse().unwrap();
    let context = Context::new(&choice).unwrap();
    println!("adapter: {}", context.adapter_line());
    println!("subgroup size: {:?}; milliseconds, least of {RUNS}", context.subgroup_size());
    for count in [10_000, 100_000, 1_000_000] {
        println!("sort of {count} pairs by 32 bits: {:.2}", sort_time(&context, count));
    }
    println!(
        "{:>9} {:>5} {:>9} {:>13} | {:>8} {:>8} {:>8} {:>8} | {:>8}",
        "Gaussians", "side", "visible", "intersections", "project", "sort", "forward", "backward", "all"
    );
    for count in [10_000, 50_000] {
        for side in [128, 256] {
            let mut bench = Bench::new(&context, count, side);
            let counts = bench.counts();
            let mut stages: BTreeMap<&str, Duration> = BTreeMap::new();
            let mut kernels: BTreeMap<&str, Duration> = BTreeMap::new();
            let mut all = Duration::MAX;
            for _ in 0..RUNS {
                let mut run_stages: BTreeMap<&str, Duration> = BTreeMap::new();
                let mut run_kernels: BTreeMap<&str, Duration> = BTreeMap::new();
                for KernelTime { name, time } in bench.run(true).0 {
                    let stage = STAGES.iter().find(|(_, kernels)| kernels.contains(&name));
                    *run_stages.entry(stage.map_or("sort", |(stage, _)| stage)).or_default() += time;
                    *run_kernels.entry(name).or_default() += time;
                }
                keep_least(&mut stages, run_stages);
                keep_least(&mut kernels, run_kernels);
                all = all.min(bench.run(false).1);
            }
            let ms = |stage: &str| stages.get(stage).map_or(f64::NAN, |time| 1e3 * time.as_secs_f64());
            println!(
                "{count:>9} {side:>5} {:>9} {:>13} | {:>8.2} {:>8.2} {:>8.2} {:>8.2} | {:>8.2}",
                counts.visible,
                counts.intersections,
                ms("project"),
                ms("sort"),
                ms("forward"),
                ms("backward"),
                1e3 * all.as_secs_f64()
            );
            if detailed {
                for (name, time) in kernels {
                    println!("{:>40} {:>8.3}", name, 1e3 * time.as_secs_f64());
                }
            }
        }
    }
}

fn keep_least<'k>(least: &mut BTreeMap<&'k str, Duration>, run: BTreeMap<&'k str, Duration>) {
    for (name, time) in run {
        least.entry(name).and_modify(|best| *best = time.min(*best)).or_insert(time);
    }
}
