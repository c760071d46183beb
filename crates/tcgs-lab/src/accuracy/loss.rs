//! Cases of the image loss: flat images and odd sizes of L1, SSIM and the wavelet constraint.

use std::sync::Arc;

use glam::{DVec3, USizeVec2};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::{
    case::{Bound, Case, Errors},
    error::CaseError,
    norms::{largest, largest_difference},
};
use tcgs_engine::train::{ImageLoss, WaveletWeights, twin};
use tcgs_render::gpu::Device;

const SSIM: &str = "SSIM, difference";
const L1: &str = "L1 and mean square, largest difference";
const WAVELET: &str = "wavelet constraint, relative";
const GRADIENT: &str = "gradient, largest difference in weights of a sample";

/// No two weights alike, so that no band can stand for another.
const UNLIKE: WaveletWeights =
    WaveletWeights { low: 0.31, fine: [0.17, 0.53, 0.29], coarse: [0.71, 0.23, 0.43] };

const fn bounds(ssim: f64, gradient: f64, why: &'static str) -> [Bound; 3] {
    [
        Bound { quantity: SSIM, largest: ssim, why },
        Bound { quantity: L1, largest: 1e-6, why: "a sum of as many f32 as there are samples, in runs" },
        Bound { quantity: GRADIENT, largest: gradient, why },
    ]
}

const FLAT: &str = "a variance is a difference of squares, 6e-8 of rounding against SSIM's constant of 9e-4, but what it \
    multiplies is as small as the difference of the images";

/// The cases.
pub(super) const CASES: &[Case] = &[
    Case { name: "ssim-flat-equal", bounds: &bounds(1e-5, 1e-3, FLAT), measure: flat_equal },
    Case { name: "ssim-flat-bright", bounds: &bounds(1e-5, 1e-3, FLAT), measure: flat_bright },
    Case { name: "ssim-flat-unlike", bounds: &bounds(1e-5, 1e-3, FLAT), measure: flat_unlike },
    Case {
        name: "wavelet-odd-sizes",
        bounds: &[
            Bound { quantity: WAVELET, largest: 1e-6, why: "a mean of absolute differences" },
            Bound {
                quantity: GRADIENT,
                largest: 1e-4,
                why: "signs of differences that are far from zero, and SSIM's gradient on noise",
            },
        ],
        measure: wavelet_odd,
    },
];

/// A render and a photograph.
struct Pair {
    size: USizeVec2,
    render: Vec<[f32; 3]>,
    photograph: Vec<[u8; 3]>,
}

impl Pair {
    fn new(
        size: [usize; 2],
        mut photograph: impl FnMut() -> [u8; 3],
        mut render: impl FnMut([u8; 3]) -> [f32; 3],
    ) -> Self {
        let photograph: Vec<[u8; 3]> = (0..size[0] * size[1]).map(|_| photograph()).collect();
        let render = photograph.iter().map(|pixel| render(*pixel)).collect();
        Self { size: USizeVec2::from(size), render, photograph }
    }

    /// One color each.
    fn flat(photograph: [u8; 3], difference: f32) -> Self {
        Self::new([40, 33], || photograph, |pixel| pixel.map(|v| f32::from(v) / 255.0 + difference))
    }

    /// Noise, no sample of which is within 0.004 of its photograph.
    fn noise(seed: u64, size: [usize; 2]) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        let mut other = Pcg64::seed_from_u64(seed + 1000);
        let mut near = move |y: u8| loop {
            let x = other.random_range(-0.1..1.1_f32);
            if (x - f32::from(y) / 255.0).abs() > 0.004 {
                return x;
            }
        };
        Self::new(size, || rng.random(), |pixel| pixel.map(&mut near))
    }

    fn compare(&self, device: &Arc<Device>, weights: Option<&WaveletWeights>) -> Result<Errors, CaseError> {
        let mut loss = ImageLoss::new(Arc::clone(device))?;
        let render: Vec<[f32; 4]> = self.render.iter().map(|[r, g, b]| [*r, *g, *b, 0.0]).collect();
        let render = device.upload("render", &render)?;
        let packed: Vec<u32> =
            self.photograph.iter().map(|[r, g, b]| u32::from_le_bytes([*r, *g, *b, 255])).collect();
        let packed = device.upload("photograph", &packed)?;
        let mut recorder = device.recorder("loss");
        let size = [self.size.x as u32, self.size.y as u32];
        let gradient = loss.record(&mut recorder, size, &render, &packed, weights)?.clone();
        recorder.submit()?;
        let Some(sums) = loss.sums()? else { return Ok(Vec::new()) };
        let found: Vec<f64> =
            device.read(&gradient)?.iter().flat_map(|p| [p[0], p[1], p[2]]).map(f64::from).collect();

        let render: Vec<DVec3> = self.render.iter().map(|p| DVec3::from(p.map(f64::from))).collect();
        let photograph: Vec<DVec3> =
            self.photograph.iter().map(|p| DVec3::from(p.map(f64::from)) / 255.0).collect();
        let ([ssim, l1, mse], mut truth) = twin::image_loss(self.size, &render, &photograph);
        let mut constraint = 0.0;
        if let Some(weights) = weights {
            let (loss, gradient) = twin::wavelet(self.size, &render, &photograph, weights);
            constraint = loss;
            truth.iter_mut().zip(gradient).for_each(|(sum, by_wavelet)| *sum += by_wavelet);
        }
        let truth: Vec<f64> = truth.iter().flat_map(DVec3::to_array).collect();
        let samples = truth.len() as f64;
        Ok(vec![
            (SSIM, (sums.ssim - ssim).abs()),
            (L1, largest([(sums.l1 - l1).abs(), (sums.mse - mse).abs()])),
            (WAVELET, (sums.wavelet - constraint).abs() / constraint.max(1e-3)),
            (GRADIENT, largest_difference(&found, &truth) * samples),
        ])
    }
}

/// Equal up to an eighth of a level, with which L1 has the same sign everywhere.
fn flat_equal(device: &Arc<Device>) -> Result<Errors, CaseError> {
    Pair::flat([128, 90, 30], 0.0005).compare(device, None)
}

/// White on white, where squares are largest against their differences.
fn flat_bright(device: &Arc<Device>) -> Result<Errors, CaseError> {
    Pair::flat([255, 254, 250], -0.0005).compare(device, None)
}

fn flat_unlike(device: &Arc<Device>) -> Result<Errors, CaseError> {
    Pair::flat([200, 120, 20], 0.17).compare(device, None)
}

fn wavelet_odd(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let mut worst: Errors = Vec::new();
    let sizes = [[1, 1], [1, 5], [5, 1], [3, 7], [13, 17], [33, 2], [31, 29]];
    for (seed, size) in (0..).zip(sizes) {
        for (i, (quantity, error)) in
            Pair::noise(seed, size).compare(device, Some(&UNLIKE))?.into_iter().enumerate()
        {
            match worst.get_mut(i) {
                Some(worst) => worst.1 = largest([worst.1, error]),
                None => worst.push((quantity, error)),
            }
        }
    }
    Ok(worst)
}
