//! The wavelet constraint: its twin and the kernel against PyWavelets (`tests/oracles/wavelet.py`), the twin's gradient
//! against central differences, the kernel against the twin.

use glam::{DVec3, USizeVec2};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use serde::Deserialize;
use tcgs::{
    eval::Haar,
    train::{ImageLoss, LossSums, WaveletWeights, twin},
};

use crate::support::{gpu::gpu, oracle::relative_l2};

const NONE: WaveletWeights = WaveletWeights { low: 0.0, fine: [0.0; 3], coarse: [0.0; 3] };

/// No two weights alike, so that no band can stand for another.
const UNLIKE: WaveletWeights =
    WaveletWeights { low: 0.31, fine: [0.17, 0.53, 0.29], coarse: [0.71, 0.23, 0.43] };

/// An image pair: the render in f32, the photograph in 8 bits.
struct Pair {
    size: USizeVec2,
    render: Vec<[f32; 3]>,
    photograph: Vec<[u8; 3]>,
}

impl Pair {
    fn noise(seed: u64, width: usize, height: usize) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        let photograph = (0..width * height).map(|_| rng.random()).collect();
        let render = (0..width * height).map(|_| [0; 3].map(|_| rng.random_range(-0.1..1.1))).collect();
        Self { size: USizeVec2::new(width, height), render, photograph }
    }

    fn render(&self) -> Vec<DVec3> {
        self.render.iter().map(|pixel| DVec3::from(pixel.map(f64::from))).collect()
    }

    fn photograph(&self) -> Vec<DVec3> {
        self.photograph.iter().map(|pixel| DVec3::from(pixel.map(f64::from)) / 255.0).collect()
    }

    fn on_twin(&self, weights: &WaveletWeights) -> (f64, Vec<f64>) {
        let (loss, gradient) = twin::wavelet(self.size, &self.render(), &self.photograph(), weights);
        (loss, gradient.iter().flat_map(DVec3::to_array).collect())
    }
}

/// Sums and gradient from the device; what the kernels must not read is NaN or noise.
fn on_device(
    loss: &mut ImageLoss,
    pair: &Pair,
    weights: Option<&WaveletWeights>,
) -> (LossSums, Vec<[f32; 4]>) {
    let device = gpu();
    let render: Vec<[f32; 4]> = pair.render.iter().map(|[r, g, b]| [*r, *g, *b, f32::NAN]).collect();
    let render = device.upload("render", &render).expect("a buffer");
    let packed: Vec<u32> =
        pair.photograph.iter().map(|[r, g, b]| u32::from_le_bytes([*r, *g, *b, r ^ b])).collect();
    let packed = device.upload("photograph", &packed).expect("a buffer");
    let mut recorder = device.recorder("loss");
    let size = [pair.size.x as u32, pair.size.y as u32];
    let gradient = loss.record(&mut recorder, size, &render, &packed, weights).expect("recorded").clone();
    recorder.submit().expect("submitted");
    (loss.sums().expect("read").expect("a loss"), device.read(&gradient).expect("read"))
}

/// One number for each band.
#[derive(Debug, Deserialize)]
struct Bands<T> {
    low: T,
    fine: [T; 3],
    coarse: [T; 3],
}

impl<T> Bands<T> {
    fn all(&self) -> impl Iterator<Item = &T> {
        std::iter::once(&self.low).chain(&self.fine).chain(&self.coarse)
    }
}

#[derive(Deserialize)]
struct Case {
    width: usize,
    height: usize,
    render_1024: Vec<f32>,
    photograph: Vec<u8>,
    bands: Bands<Vec<f64>>,
    l1: Bands<f64>,
}

impl Case {
    fn pair(&self) -> Pair {
        let render = self.render_1024.chunks_exact(3).map(|p| [p[0], p[1], p[2]].map(|v| v / 1024.0));
        let photograph = self.photograph.chunks_exact(3).map(|p| [p[0], p[1], p[2]]);
        Pair {
            size: USizeVec2::new(self.width, self.height),
            render: render.collect(),
            photograph: photograph.collect(),
        }
    }
}

fn cases() -> Vec<Case> {
    #[derive(Deserialize)]
    struct Oracle {
        cases: Vec<Case>,
    }
    let oracle: Oracle =
        serde_json::from_str(include_str!("../../oracles/wavelet.json")).expect("the oracle");
    assert_eq!(oracle.cases.len(), 8);
    oracle.cases
}

/// Weights with which the constraint is one band's mean absolute difference, in the order of [`Bands::all`].
fn single_bands() -> [WaveletWeights; 7] {
    let band = |place: usize| std::array::from_fn(|other| f64::from(u8::from(other == place)));
    [
        WaveletWeights { low: 1.0, ..NONE },
        WaveletWeights { fine: band(0), ..NONE },
        WaveletWeights { fine: band(1), ..NONE },
        WaveletWeights { fine: band(2), ..NONE },
        WaveletWeights { coarse: band(0), ..NONE },
        WaveletWeights { coarse: band(1), ..NONE },
        WaveletWeights { coarse: band(2), ..NONE },
    ]
}

#[test]
fn the_bands_are_those_of_pywavelets() {
    for case in cases() {
        let pair = case.pair();
        let fine = Haar::of(pair.size, &pair.render());
        let coarse = Haar::of(fine.size, &fine.low);
        let found = Bands { low: coarse.low, fine: fine.high, coarse: coarse.high };
        for (found, expected) in found.all().zip(case.bands.all()) {
            let found: Vec<f64> = found.iter().flat_map(DVec3::to_array).collect();
            assert_eq!(found.len(), expected.len(), "{}", pair.size);
            let near = |(a, b): (&f64, &f64)| (a - b).abs() < 1e-13;
            assert!(found.iter().zip(expected).all(near), "{}: {found:?} {expected:?}", pair.size);
        }
    }
}

#[test]
fn the_bands_distances_on_twin_and_device_are_those_of_pywavelets() {
    let mut loss = ImageLoss::new(gpu()).expect("the kernels");
    for case in cases() {
        let pair = case.pair();
        for (weights, expected) in single_bands().iter().zip(case.l1.all()) {
            let (on_twin, _) = pair.on_twin(weights);
            assert!((on_twin - expected).abs() < 1e-13, "{} {weights:?}: {on_twin} {expected}", pair.size);
            let on_device = on_device(&mut loss, &pair, Some(weights)).0.wavelet;
            assert!((on_device - expected).abs() < 2e-6, "{} {weights:?}: {on_device} {expected}", pair.size);
        }
    }
}

#[test]
fn the_twins_gradient_is_that_of_its_loss() {
    for (width, height) in [(5, 7), (9, 4), (1, 1), (2, 3), (8, 8)] {
        let pair = Pair::noise(1, width, height);
        let (render, photograph) = (pair.render(), pair.photograph());
        let (_, gradient) = twin::wavelet(pair.size, &render, &photograph, &UNLIKE);
        for (pixel, found) in gradient.iter().enumerate() {
            for channel in 0..3 {
                let at = |by: f64| {
                    let mut render = render.clone();
                    render[pixel][channel] += by;
                    twin::wavelet(pair.size, &render, &photograph, &UNLIKE).0
                };
                // Linear between kinks, which no coefficient of this noise is near.
                let expected = (at(1e-6) - at(-1e-6)) / 2e-6;
                let error = (found[channel] - expected).abs();
                assert!(error < 1e-9, "{width}x{height} {pixel}: {} {expected}", found[channel]);
            }
        }
    }
}

#[test]
fn the_kernel_matches_the_twin_whatever_the_size() {
    let mut loss = ImageLoss::new(gpu()).expect("the kernels");
    // 130 x 70 has blocks in more than one workgroup and pixels in more than one run of the sum.
    for (width, height) in [(5, 7), (9, 4), (1, 1), (130, 70), (2, 3), (1, 40), (40, 1), (8, 8), (67, 6)] {
        let pair = Pair::noise((width * height) as u64, width, height);
        let (_, plain) = on_device(&mut loss, &pair, None);
        for weights in [UNLIKE, WaveletWeights::at(0.3), WaveletWeights::at(0.9)] {
            let (sums, gradient) = on_device(&mut loss, &pair, Some(&weights));
            let (expected_loss, expected) = pair.on_twin(&weights);
            assert!((sums.wavelet - expected_loss).abs() < 1e-5 * expected_loss, "{}", pair.size);
            let added = |(with, without): (&[f32; 4], &[f32; 4])| {
                [0, 1, 2].map(|channel| f64::from(with[channel]) - f64::from(without[channel]))
            };
            let found: Vec<f64> = gradient.iter().zip(&plain).flat_map(added).collect();
            // Added to other gradients, whose rounding is in the difference.
            let error = relative_l2(&found, &expected);
            assert!(error < 1e-4, "{}: {error:e}", pair.size);
            assert!(gradient.iter().all(|pixel| pixel[3] == 0.0), "there is no gradient by alpha");
        }
    }
}

#[test]
fn the_constraint_adds_to_the_loss_and_leaves_the_other_figures() {
    let pair = Pair::noise(2, 21, 18);
    let mut loss = ImageLoss::new(gpu()).expect("the kernels");
    let (with, _) = on_device(&mut loss, &pair, Some(&UNLIKE));
    // After a loss with the constraint, to see that nothing of it stays.
    let (without, _) = on_device(&mut loss, &pair, None);
    assert_eq!(without.wavelet, 0.0);
    assert_eq!(LossSums { wavelet: 0.0, ..with }, without);
    assert!(with.wavelet > 0.1 && (with.loss() - without.loss() - with.wavelet).abs() < 1e-12);
}

#[test]
fn weights_of_zero_change_no_bit_and_equal_weights_give_equal_bits() {
    let pair = Pair::noise(3, 97, 65);
    let mut loss = ImageLoss::new(gpu()).expect("the kernels");
    let bits = |(sums, gradient): (LossSums, Vec<[f32; 4]>)| {
        let gradient: Vec<u32> = gradient.iter().flatten().map(|v| v.to_bits()).collect();
        ([sums.ssim, sums.l1, sums.mse, sums.wavelet].map(f64::to_bits), gradient)
    };
    let without = bits(on_device(&mut loss, &pair, None));
    assert!(bits(on_device(&mut loss, &pair, Some(&NONE))) == without);
    let with = bits(on_device(&mut loss, &pair, Some(&UNLIKE)));
    on_device(&mut loss, &Pair::noise(4, 97, 65), Some(&UNLIKE));
    assert!(bits(on_device(&mut loss, &pair, Some(&UNLIKE))) == with);
    assert!(with.1 != without.1);
}

#[test]
fn equal_images_have_no_constraint_and_no_gradient_of_it() {
    // 0 and 255 decode exactly on every adapter.
    let mut rng = Pcg64::seed_from_u64(5);
    let photograph: Vec<[u8; 3]> =
        (0..15 * 10).map(|_| [0; 3].map(|_| 255 * u8::from(rng.random::<bool>()))).collect();
    let render = photograph.iter().map(|pixel| pixel.map(|v| f32::from(v) / 255.0)).collect();
    let pair = Pair { size: USizeVec2::new(15, 10), render, photograph };
    let mut loss = ImageLoss::new(gpu()).expect("the kernels");
    let (_, plain) = on_device(&mut loss, &pair, None);
    let (sums, gradient) = on_device(&mut loss, &pair, Some(&UNLIKE));
    assert_eq!(sums.wavelet, 0.0);
    assert!(gradient == plain);
}

#[test]
fn an_error_in_an_edge_counts_more_late_and_one_in_brightness_early() {
    let size = USizeVec2::new(16, 16);
    let photograph = vec![[100_u8; 3]; 256];
    let pair = |value: fn(usize) -> f32| Pair {
        size,
        render: (0..256).map(|pixel| [value(pixel); 3]).collect(),
        photograph: photograph.clone(),
    };
    let brighter = pair(|_| 0.5);
    let striped = pair(|pixel| if pixel % 4 < 2 { 0.5 } else { 2.0 * 100.0 / 255.0 - 0.5 });
    let at = |pair: &Pair, fraction: f64| pair.on_twin(&WaveletWeights::at(fraction)).0;
    let steps = [0.0, 0.25, 0.5, 0.75, 0.95];
    assert!(steps.windows(2).all(|pair| at(&brighter, pair[1]) < at(&brighter, pair[0])));
    assert!(steps.windows(2).all(|pair| at(&striped, pair[1]) > at(&striped, pair[0])));
}
