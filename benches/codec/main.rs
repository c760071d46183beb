//! Times of encoding and decoding by stage: `cargo bench --bench codec`.
//!
//! The scene is synthetic, 200 000 anchors with all of 50 + 6 + 30 symbols each. Arguments choose other numbers of
//! anchors, and a share such as `-- 0.4` masks off that part of the offsets. The codec runs on four threads
//! (`RAYON_NUM_THREADS` chooses otherwise). Each figure is of the fastest of several runs, which load on the machine
//! disturbs least.
//!
//! `MB` is what a stage must at least read and write, `Msym/s` symbols per second. `of copy` says which share of the rate
//! of a plain copy its bytes go at, `of sums` which share of the rate of plain products its products; a stage that codes
//! symbols one after another is far below both, and its symbols a second are what counts.

#![allow(clippy::unwrap_used, reason = "a benchmark stops at the first error")]

mod ceilings;
mod context;
mod stages;
#[allow(dead_code, reason = "the tests use all of it")]
#[path = "../../crates/tcgs-codec/tests/it/synthetic.rs"]
mod synthetic;
mod work;

use std::time::{Duration, Instant};

use tcgs::{
    codec::{DecodeLimits, EncodeSettings, decode, encode},
    domain::{AnchorScene, ContextCandidates},
};
use tracing_subscriber::layer::SubscriberExt;

use ceilings::Ceilings;
use stages::{Stage, Stages};
use synthetic::{Recipe, settings};
use work::Work;

const RUNS: usize = 7;
const ANCHORS: usize = 200_000;
const FEATURES: usize = 50;
const OFFSETS: usize = 10;
const THREADS: usize = 4;

/// The fastest of [`RUNS`] runs with its stages.
fn fastest<T>(stages: &Stages, mut run: impl FnMut() -> T) -> (Duration, Vec<Stage>, T) {
    let mut best: Option<(Duration, Vec<Stage>, T)> = None;
    for _ in 0..RUNS {
        stages.take();
        let start = Instant::now();
        let result = run();
        let time = start.elapsed();
        if best.as_ref().is_none_or(|(least, ..)| time < *least) {
            best = Some((time, stages.take(), result));
        }
    }
    best.unwrap()
}

fn table(what: &str, time: Duration, stages: &[Stage], work: &Work, ceilings: Ceilings) {
    println!("\n{what}: {:.3} s", time.as_secs_f64());
    println!(
        "{:32} {:>8} {:>6} {:>8} {:>8} {:>8} {:>8}",
        "stage", "ms", "share", "MB", "Msym/s", "of copy", "of sums"
    );
    for stage in stages {
        let seconds = stage.time.as_secs_f64();
        let depth = stage.path.matches('/').count();
        let name = stage.path.rsplit('/').next().unwrap();
        let cost = work.of(&stage.path);
        let figure = |value: f64, digits: usize| match value {
            0.0 => "-".to_owned(),
            _ => format!("{value:.digits$}"),
        };
        let percent = |value: f64| match value {
            0.0 => "-".to_owned(),
            _ => format!("{:.1}%", 100.0 * value),
        };
        println!(
            "{:32} {:>8.1} {:>5.1}% {:>8} {:>8} {:>8} {:>8}",
            format!("{}{name}", "  ".repeat(depth)),
            1e3 * seconds,
            100.0 * seconds / time.as_secs_f64(),
            figure(1e-6 * cost.bytes, 1),
            figure(1e-6 * cost.symbols / seconds, 1),
            percent(cost.bytes / seconds / ceilings.copy),
            percent(cost.operations / seconds / ceilings.arithmetic),
        );
    }
}

/// Encodes and decodes `scene` with one fixed choice of contexts.
fn bench(
    stages: &Stages,
    ceilings: Ceilings,
    scene: &AnchorScene,
    context: Option<&ContextCandidates>,
    settings: &EncodeSettings,
) {
    let (time, encode_stages, encoded) = fastest(stages, || encode(scene, context, settings).unwrap());
    let counts = &encoded.byte_counts;
    let work = Work::new(scene, counts);
    println!(
        "\n{} anchors, {} offsets of {}, {} symbols, {}: {} bytes (features {}, scalings {}, offsets {}, positions {}, \
         masks {}, networks {}, planes {})",
        scene.len(),
        scene.gaussians(),
        scene.len() * OFFSETS,
        work.symbols(),
        if context.is_some() { "planes and neighbors" } else { "tables a channel" },
        counts.total,
        counts.features,
        counts.scalings,
        counts.offsets,
        counts.positions,
        counts.masks,
        counts.networks,
        counts.planes
    );
    table("encode", time, &encode_stages, &work, ceilings);
    let limits = DecodeLimits::default();
    let (time, decode_stages, decoded) = fastest(stages, || decode(&encoded.bytes, &limits).unwrap());
    table("decode", time, &decode_stages, &work, ceilings);
    assert_eq!(decoded.scene, encoded.scene);
}

fn main() {
    let asked: Vec<f64> = std::env::args().skip(1).filter_map(|text| text.parse().ok()).collect();
    let masked = asked.iter().copied().find(|number| *number < 1.0).unwrap_or(0.0);
    let mut anchors: Vec<usize> =
        asked.iter().filter(|number| **number >= 1.0).map(|n| *n as usize).collect();
    if anchors.is_empty() {
        anchors.push(ANCHORS);
    }
    let threads =
        std::env::var("RAYON_NUM_THREADS").ok().and_then(|text| text.parse().ok()).unwrap_or(THREADS);
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().unwrap();
    let stages = Stages::default();
    let subscriber = tracing_subscriber::registry().with(stages.clone());
    tracing::subscriber::set_global_default(subscriber).unwrap();

    let ceilings = Ceilings::measure();
    println!(
        "{threads} threads; ceilings: copy {:.1} GB/s, products and sums {:.1} Gop/s; fastest of {RUNS} runs",
        1e-9 * ceilings.copy,
        1e-9 * ceilings.arithmetic
    );
    for anchors in anchors {
        let recipe = Recipe { seed: 1, anchors, feature_dim: FEATURES, offsets: OFFSETS, masked };
        let scene: AnchorScene = synthetic::scene(recipe);
        bench(&stages, ceilings, &scene, None, &settings());
        let candidates = context::candidates(&scene);
        let fixed = EncodeSettings { context: context::FIXED, ..settings() };
        bench(&stages, ceilings, &scene, Some(&candidates), &fixed);
    }
}
