//! Cases of long sums: ten million intersections, slots of one Gaussian, samples of an image. Truth is a closed form.

use std::sync::Arc;

use glam::DVec3;

use super::{
    case::{Bound, Case, Errors},
    error::CaseError,
    norms::largest,
    raster::{BACKGROUND, PLAIN, render_image},
    scenes::forward_camera,
};
use tcgs_engine::train::ImageLoss;
use tcgs_render::{Rasterizer, gpu::Device, sum_slots, twin::Gaussian};

const COUNT: &str = "intersections, difference of the count";
const IMAGE: &str = "image, largest difference";
const SLOTS: &str = "sum of slots, relative";
const MEANS: &str = "L1 and mean square, relative";

/// The cases.
pub(super) const CASES: &[Case] = &[
    Case {
        name: "ten-million-intersections",
        bounds: &[
            Bound { quantity: COUNT, largest: 0.0, why: "prefix sums are of integers" },
            Bound {
                quantity: IMAGE,
                largest: 1e-5,
                why: "fourteen layers, each with a few roundings of 6e-8",
            },
        ],
        measure: intersections,
    },
    Case {
        name: "ten-million-slots",
        bounds: &[Bound {
            quantity: SLOTS,
            largest: 2e-5,
            why: "runs of 256, runs of 256 of those, and sums of those: no chain is longer than 256 roundings of 6e-8",
        }],
        measure: slots,
    },
    Case {
        name: "three-million-samples",
        bounds: &[Bound {
            quantity: MEANS,
            largest: 2e-5,
            why: "runs of at most 256 samples, then of 4096 runs",
        }],
        measure: samples,
    },
];

/// Gaussians that cover 1024 tiles each, all of one opacity in every pixel; the nearest fourteen are blended.
fn intersections(device: &Arc<Device>) -> Result<Errors, CaseError> {
    const LAYERS: u32 = 9766;
    let color = |i: u32| DVec3::new(1.0, 0.5, f64::from(i % 2));
    let scene: Vec<Gaussian> = (0..LAYERS)
        // Farthest first, so that order has to be made.
        .rev()
        .map(|i| Gaussian {
            mean: DVec3::new(0.0, 0.0, 4.0 + f64::from(i) / 128.0),
            opacity: 0.5,
            scale: DVec3::splat(1e5),
            quat: [1.0, 0.0, 0.0, 0.0],
            color: color(i),
        })
        .collect();
    let (counts, image) = render_image(device, PLAIN, &scene, &forward_camera(16_384, 16))?;
    let mut truth = [0.0; 4];
    let mut left = 1.0;
    for i in 0..LAYERS {
        if left * 0.5 <= 1e-4 {
            break;
        }
        let color = color(i).to_array();
        (0..3).for_each(|channel| truth[channel] += 0.5 * left * color[channel]);
        left *= 0.5;
    }
    (0..3).for_each(|channel| truth[channel] += left * f64::from(BACKGROUND[channel]));
    truth[3] = left;
    let error = |pixel: &[f32; 4]| largest([0, 1, 2, 3].map(|k| (f64::from(pixel[k]) - truth[k]).abs()));
    let missing = i64::from(counts.intersections) - 1024 * i64::from(LAYERS);
    Ok(vec![(COUNT, missing.unsigned_abs() as f64), (IMAGE, largest(image.iter().map(error)))])
}

/// Ten million slots of two Gaussians, or as many as the adapter binds (3.7 million where a binding has 128 MiB).
fn slots(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let count = Rasterizer::max_bindable_intersections(device.adapter()).min(10_000_000) as u32;
    let tiles = [1000, count - 1000];
    let value = 0.1_f32;
    let gradients = device.upload("gradients of slots", &vec![value; 9 * count as usize])?;
    let sums = sum_slots(device, &gradients, &tiles)?;
    let errors = sums.iter().zip(tiles).flat_map(|(sums, tiles)| {
        let truth = f64::from(tiles) * f64::from(value);
        sums.map(|sum| (f64::from(sum) / truth - 1.0).abs())
    });
    Ok(vec![(SLOTS, largest(errors))])
}

/// An image of a million pixels whose samples all differ from the photograph's by the same.
fn samples(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let side = 1024_u32;
    let pixels = (side * side) as usize;
    let mut loss = ImageLoss::new(Arc::clone(device))?;
    let value = 0.3_f32;
    let render = device.upload("render", &vec![[value; 4]; pixels])?;
    let black = device.upload("photograph", &vec![u32::from_le_bytes([0, 0, 0, 255]); pixels])?;
    let mut recorder = device.recorder("loss");
    loss.record(&mut recorder, [side, side], &render, &black, None)?;
    recorder.submit()?;
    let Some(sums) = loss.sums()? else { return Ok(Vec::new()) };
    let value = f64::from(value);
    Ok(vec![(MEANS, largest([(sums.l1 / value - 1.0).abs(), (sums.mse / (value * value) - 1.0).abs()]))])
}
