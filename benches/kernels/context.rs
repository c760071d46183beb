//! Time of the context model in a training step: from a sample of anchors to outputs, and from the gradients by these to
//! every parameter, as each stage of training uses it.

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    codec::context::robust_frame,
    domain::ContextKind,
    gpu::{Device, Recorder},
    train::{
        TrainError,
        context::{
            ContextAnchors, ContextConfig, ContextLayout, ContextNet, ContextPass, ContextState,
            GroupStatistics, PlaneSource,
        },
    },
};

/// Anchors and those of them that are sampled.
const SCENES: [[usize; 2]; 2] = [[7_000, 1_000], [40_000, 6_000]];

/// Channels of features, scalings and offsets.
const CHANNELS: [usize; 3] = [32, 6, 30];

/// The stages of training, in their order.
fn passes() -> [(&'static str, ContextPass); 3] {
    let raw = ContextPass::RAW;
    [
        ("raw planes", raw),
        ("with reconstruction", ContextPass { reconstruction: 0.01, ..raw }),
        ("stored form", ContextPass { source: PlaneSource::Latents, levels: Some(127), ..raw }),
    ]
}

/// Prints a table of minimum times; with `detail`, those of kernels.
pub(crate) fn table(device: &Arc<Device>, runs: usize, detail: bool) -> Result<(), TrainError> {
    for [count, sampled] in SCENES {
        let mut rng = Pcg64::seed_from_u64(1);
        // On a sphere, as anchors of a surface lie.
        let cells: Vec<[i32; 3]> = (0..count)
            .map(|_| {
                let ray = glam::DVec3::from([0; 3].map(|_| rng.random_range(-1.0..1.0)));
                (200.0 * ray.normalize_or_zero()).round().to_array().map(|v| v as i32)
            })
            .collect();
        let config = ContextConfig::for_anchors(ContextKind::TriPlaneKnn, CHANNELS, count);
        let statistics = CHANNELS
            .map(|channels| GroupStatistics { means: vec![0.0; channels], deviations: vec![1.0; channels] });
        let values = ContextLayout::new(config)?.initial(&statistics, &mut rng)?;
        let mut net = ContextNet::new(device, config, &ContextState::new(values))?;
        let start = Instant::now();
        net.place(&ContextAnchors::new(&config, &robust_frame(&cells), &cells))?;
        device.wait()?;
        println!(
            "\ncontext of {sampled} of {count} anchors: {} parameters, {:.2} MB; tables of anchors in {:.1} ms",
            net.layout().parameters,
            1e-6 * ContextNet::bytes(&config, count, sampled)? as f64,
            1e3 * start.elapsed().as_secs_f64()
        );
        println!("{:>22} {:>11} {:>11}", "ms", "forward", "with backward");
        let sample: Vec<u32> = (0..sampled as u32).map(|i| i * (count / sampled) as u32).collect();
        for (name, pass) in passes() {
            let record = |net: &mut ContextNet, recorder: &mut Recorder<'_>, backward: bool| {
                net.forward(recorder, &sample, &pass)?;
                if backward { net.backward(recorder) } else { Ok(()) }
            };
            let mut least = [Duration::MAX; 2];
            let mut kernels = BTreeMap::new();
            for run in 0..=runs {
                for (least, backward) in least.iter_mut().zip([false, true]) {
                    let start = Instant::now();
                    let mut recorder = device.recorder("context");
                    record(&mut net, &mut recorder, backward)?;
                    recorder.submit()?;
                    device.wait()?;
                    // The first run makes buffers and kernels.
                    if run > 0 {
                        *least = start.elapsed().min(*least);
                    }
                }
                let mut recorder = device.timed_recorder("context");
                record(&mut net, &mut recorder, true)?;
                let mut times = BTreeMap::new();
                for kernel in recorder.submit_timed()? {
                    *times.entry(kernel.name).or_insert(Duration::ZERO) += kernel.time;
                }
                super::keep_least(&mut kernels, times);
            }
            let [forward, both] = least.map(|time| 1e3 * time.as_secs_f64());
            println!("{name:>22} {forward:>11.2} {both:>11.2}");
            if detail {
                for (name, time) in kernels {
                    println!("{name:>40} {:>8.3}", 1e3 * time.as_secs_f64());
                }
            }
        }
    }
    Ok(())
}
