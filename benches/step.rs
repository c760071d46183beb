//! Times of a training step's kernels outside the rasteriser: `cargo bench --bench step`. `TCGS_ADAPTER` chooses the
//! adapter. Each figure is the least of several runs, which load on the machine disturbs least. The sums under the
//! tables change only in their last digits when a kernel's order of additions changes, and stay when nothing does.

#![allow(clippy::unwrap_used, reason = "a benchmark stops at the first fault")]

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::{Camera, Intrinsics, Pose},
    gpu::{AdapterChoice, Buffer, Context, KernelTime},
    model::{NetworkLayout, Shape, VoxelRule, initial_rows, random_points},
    render::{AnchorGradients, DeviceAnchors, NeuralGaussians},
    train::{Adam, ImageLoss, Moments, WaveletWeights},
};

const RUNS: usize = 10;
const SHAPE: Shape = Shape { features: 32, offsets: 10 };

/// Least total time of each kernel in a run.
type Times = BTreeMap<&'static str, Duration>;

fn keep_least(least: &mut Times, run: Vec<KernelTime>) {
    let mut totals = Times::new();
    for KernelTime { name, time } in run {
        *totals.entry(name).or_default() += time;
    }
    for (name, time) in totals {
        least.entry(name).and_modify(|best| *best = time.min(*best)).or_insert(time);
    }
}

/// A sum of magnitudes in which every place counts differently.
fn sum(values: &[f32]) -> f64 {
    let weight = |i: usize| 1.0 + (i as f64 * 0.618_033_988_75).fract();
    values.iter().enumerate().map(|(i, v)| weight(i) * f64::from(v.abs())).sum()
}

fn flat(rows: &[[f32; 4]]) -> Vec<f32> {
    rows.iter().flatten().copied().collect()
}

/// Prints each kernel's time, and its rate where `work` says how much it does: the amount and the unit of a billion a
/// second.
fn print(title: &str, times: &Times, work: &BTreeMap<&str, (f64, &str)>) {
    println!("\n{title}\n{:>24} {:>9}", "kernel", "ms");
    for (name, time) in times {
        let seconds = time.as_secs_f64();
        let rate = work.get(name).map(|(amount, unit)| format!("{:>9.2} {unit}", amount / seconds / 1e9));
        println!("{name:>24} {:>9.2} {}", 1e3 * seconds, rate.unwrap_or_default());
    }
    let all: Duration = times.values().sum();
    println!("{:>24} {:>9.2}", "all", 1e3 * all.as_secs_f64());
}

fn networks(context: &Arc<Context>, count: usize) {
    let mut rng = Pcg64::seed_from_u64(1);
    let points = random_points(&mut rng, count, [-1.0; 3], [1.0; 3]);
    let mut rows = initial_rows(&points, VoxelRule::OfSpacing(1.0 / 16.0), SHAPE, usize::MAX).unwrap();
    for row in rows.values.chunks_exact_mut(SHAPE.row()) {
        row[..SHAPE.features].fill_with(|| rng.random_range(-1.0..1.0));
        row[SHAPE.offset_column()..].fill_with(|| rng.random_range(-1.0..1.0));
    }
    let layout = NetworkLayout::new(SHAPE);
    let anchors = DeviceAnchors::upload(context, &rows, &layout.initial(&mut rng)).unwrap();
    let out = AnchorGradients::new(context, SHAPE, anchors.count).unwrap();
    let pose = Pose::look_at(DVec3::new(4.5, 1.0, 1.5), DVec3::ZERO, DVec3::Z).unwrap();
    let camera = Camera::new(Intrinsics::from_horizontal_fov(1.0, 200, 200).unwrap(), pose).unwrap();
    let mut neural = NeuralGaussians::new(Arc::clone(context), SHAPE, 0.01).unwrap();
    let mut times = Times::new();
    for round in 0..RUNS {
        let mut recorder = context.timed_recorder("forward");
        neural.forward(&mut recorder, &anchors, &camera, 0.01).unwrap();
        let mut run = recorder.submit_timed().unwrap();
        if round == 0 {
            let gradients = neural.gaussian_gradients().unwrap();
            for buffer in [&gradients.means_opacity, &gradients.scales, &gradients.quats, &gradients.colors] {
                let values: Vec<[f32; 4]> =
                    (0..buffer.len()).map(|_| [0; 4].map(|_| rng.random_range(-1.0..1.0))).collect();
                context.write(buffer, &values);
            }
        }
        let mut recorder = context.timed_recorder("backward");
        neural.backward(&mut recorder, &anchors, &out).unwrap();
        run.extend(recorder.submit_timed().unwrap());
        keep_least(&mut times, run);
    }
    let [_, living, visible] = neural.counts().unwrap();
    let layers = std::iter::once(&layout.hidden).chain(&layout.heads);
    let products: usize = layers.map(|layer| layer.inputs * layer.outputs).sum();
    // Nothing asks for the gradient by the view direction and the distance.
    let unwanted = (layout.hidden.inputs - SHAPE.features) * layout.hidden.outputs;
    let flops = |products: usize| (2.0 * products as f64 * f64::from(visible), "GFLOP/s");
    let work = BTreeMap::from([
        ("dense", flops(2 * products - unwanted)),
        ("dense_weight_gradient", flops(products)),
    ]);
    print(&format!("{count} anchors, {visible} visible, {living} Gaussians"), &times, &work);
    println!(
        "sums: colours {:.6e}, by rows {:.6e}, by networks {:.6e}",
        sum(&flat(
            &context.read_range(&neural.gaussians().colors, 0, visible as usize * SHAPE.offsets).unwrap()
        )),
        sum(&context.read(&out.rows).unwrap()),
        sum(&context.read(&out.networks).unwrap())
    );
}

fn adam(context: &Arc<Context>, count: usize) {
    let mut rng = Pcg64::seed_from_u64(2);
    let len = count * SHAPE.row();
    let mut random = || -> Vec<f32> { (0..len).map(|_| rng.random_range(-1.0..1.0)).collect() };
    let (values, gradients) = (random(), random());
    let values = context.upload("values", &values).unwrap();
    let gradients = context.upload("gradients", &gradients).unwrap();
    let rates: Vec<f32> = (1..=SHAPE.row()).map(|i| 1e-3 * i as f32).collect();
    let rates = context.upload("rates", &rates).unwrap();
    let moments = Moments::zero(context, len).unwrap();
    let adam = Adam::new(context).unwrap();
    let no = context.upload("void mark", &[0]).unwrap();
    let mut times = Times::new();
    for step in 1..=RUNS {
        let mut recorder = context.timed_recorder("adam");
        adam.step(&mut recorder, step as u32, &no, &rates, &gradients, &values, &moments).unwrap();
        keep_least(&mut times, recorder.submit_timed().unwrap());
    }
    // Four arrays read and three written.
    let work = BTreeMap::from([("adam", (28.0 * len as f64, "GB/s"))]);
    print(&format!("{count} rows of {} parameters", SHAPE.row()), &times, &work);
    println!("sums: values {:.6e}", sum(&context.read(&values).unwrap()));
}

fn loss(context: &Arc<Context>, size: [u32; 2]) {
    let mut rng = Pcg64::seed_from_u64(3);
    let pixels = (size[0] * size[1]) as usize;
    let render: Vec<[f32; 4]> = (0..pixels).map(|_| [0; 4].map(|_| rng.random_range(0.0..1.0))).collect();
    let photograph: Vec<u32> = (0..pixels).map(|_| rng.random()).collect();
    let render: Buffer<[f32; 4]> = context.upload("render", &render).unwrap();
    let mut image_loss = ImageLoss::new(Arc::clone(context)).unwrap();
    let weights = WaveletWeights::at(0.5);
    let mut times = Times::new();
    let mut gradient = None;
    for _ in 0..RUNS {
        let mut recorder = context.timed_recorder("loss");
        gradient = Some(
            image_loss.record(&mut recorder, size, &render, &photograph, Some(&weights)).unwrap().clone(),
        );
        keep_least(&mut times, recorder.submit_timed().unwrap());
    }
    let work = ["ssim_rows", "ssim_columns", "ssim_gradient_rows", "image_gradient", "wavelet"]
        .map(|name| (name, (1e3 * pixels as f64, "Mpixel/s")));
    print(&format!("image of {} x {}", size[0], size[1]), &times, &work.into_iter().collect());
    let sums = image_loss.sums().unwrap().unwrap();
    println!(
        "sums: SSIM {:.8}, L1 {:.8}, squares {:.8}, wavelet {:.8}, gradient {:.6e}",
        sums.ssim,
        sums.l1,
        sums.mse,
        sums.wavelet,
        sum(&flat(&context.read(&gradient.unwrap()).unwrap()))
    );
}

fn main() {
    let wanted: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let asked = |part: &str| wanted.is_empty() || wanted.iter().any(|name| name == part);
    let choice: AdapterChoice =
        std::env::var("TCGS_ADAPTER").unwrap_or_else(|_| "lavapipe".to_owned()).parse().unwrap();
    let context = Context::new(&choice).unwrap();
    println!("adapter: {}", context.adapter_line());
    println!("subgroup size: {:?}; least of {RUNS} runs", context.subgroup_size());
    for count in [5_000, 20_000] {
        if asked("networks") {
            networks(&context, count);
        }
        if asked("adam") {
            adam(&context, count);
        }
    }
    for size in [[200, 200], [266, 475]] {
        if asked("loss") {
            loss(&context, size);
        }
    }
}
