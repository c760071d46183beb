//! That the parts learn together.

use rand::SeedableRng;
use rand_pcg::Pcg64;
use tcgs::{
    codec::context::robust_frame,
    domain::ContextKind,
    train::{
        Adam, AdamStep,
        context::{
            ContextAnchors, ContextConfig, ContextLayout, ContextLearningRates, ContextNet, ContextPass,
            ContextState, GroupStatistics, PlaneConfig, PlaneSource,
        },
    },
};

use crate::support::gpu::gpu;

const COUNT: usize = 1_200;

/// Anchors on a bumpy sheet, and a value that goes by where they are: a checkerboard.
fn sheet() -> (Vec<[i32; 3]>, Vec<f32>) {
    let cells: Vec<[i32; 3]> = (0..COUNT as i32).map(|i| [i % 40, i / 40, (i * i) % 3]).collect();
    let value = |cell: &[i32; 3]| if (cell[0] / 8 + cell[1] / 8) % 2 == 0 { 150.0 } else { 50.0 };
    let values = cells.iter().map(value).collect();
    (cells, values)
}

/// Trains the first channel's mean on the sheet; says the mean squared error before, then at the end of each phase.
fn errors(kind: ContextKind) -> [f32; 4] {
    let device = gpu();
    let (cells, targets) = sheet();
    let planes = PlaneConfig { edge: 16, channels: 4, layers: 1, hidden: 0, latents: 4 };
    let config = ContextConfig { kind, channels: [1, 6, 3], hidden: [16, 4, 4], planes };
    let statistics = config
        .channels
        .map(|channels| GroupStatistics { means: vec![100.0; channels], deviations: vec![50.0; channels] });
    let layout = ContextLayout::new(config).expect("known sizes");
    let values = layout.initial(&statistics, &mut Pcg64::seed_from_u64(1)).expect("statistics that fit");
    let mut net = ContextNet::new(&device, config, &ContextState::new(values)).expect("a model");
    net.place(&ContextAnchors::new(&config, &robust_frame(&cells), &cells)).expect("placed");
    let adam = Adam::new(&device).expect("the kernel");
    let no = device.upload("overflow flag", &[0]).expect("a buffer");
    let all: Vec<u32> = (0..COUNT as u32).collect();
    let mut step = 0;
    let mut phase = |net: &mut ContextNet, steps: u32, pass: ContextPass| -> f32 {
        let predictions = |net: &mut ContextNet, sample: &[u32]| -> Vec<f32> {
            let mut recorder = device.recorder("forward");
            net.forward(&mut recorder, sample, &pass).expect("recorded");
            recorder.submit().expect("submitted");
            device.read_range(net.outputs(), 0, sample.len()).expect("read")
        };
        for _ in 0..steps {
            step += 1;
            // A seventh in turn; seven and the sheet's width have no common factor.
            let sample: Vec<u32> = (step % 7..COUNT as u32).step_by(7).collect();
            let predicted = predictions(net, &sample);
            let mut gradients = vec![0.0; net.output_gradients().len()];
            for (column, (anchor, predicted)) in sample.iter().zip(predicted).enumerate() {
                gradients[column] = (predicted - targets[*anchor as usize]) / 2_500.0 / sample.len() as f32;
            }
            device.write(net.output_gradients(), &gradients);
            let rates = ContextLearningRates { networks: 5e-3, planes: 5e-3, layers: 5e-3, latents: 1e-2 };
            let mut recorder = device.recorder("backward");
            net.backward(&mut recorder).expect("recorded");
            net.step(
                &mut recorder,
                &adam,
                AdamStep { number: step, overflow_flag: &no },
                &rates,
                &statistics,
            )
            .expect("recorded");
            recorder.submit().expect("submitted");
        }
        let found = predictions(net, &all);
        found.iter().zip(&targets).map(|(a, b)| (a - b) * (a - b)).sum::<f32>() / COUNT as f32
    };
    let raw = ContextPass { reconstruction: 0.01, ..ContextPass::RAW };
    let stored = ContextPass { source: PlaneSource::Latents, levels: Some(127), ..ContextPass::RAW };
    let start = phase(&mut net, 0, ContextPass::RAW);
    let first = phase(&mut net, 150, ContextPass::RAW);
    let second = phase(&mut net, 150, raw);
    let mut recorder = device.recorder("switch");
    net.latents_from_planes(&mut recorder).expect("recorded");
    recorder.submit().expect("submitted");
    [start, first, second, phase(&mut net, 150, stored)]
}

#[test]
fn planes_learn_what_goes_by_place_and_keep_it_when_they_are_stored() {
    let [start, raw, reconstructing, stored] = errors(ContextKind::TriPlane);
    assert!((start - 2_500.0).abs() < 1.0, "it begins with the mean and its deviation: {start}");
    assert!(raw < 0.5 * start, "{raw}");
    assert!(reconstructing < 0.2 * start, "{reconstructing}");
    assert!(stored < 0.2 * start, "rounded latents and weights: {stored}");
}
