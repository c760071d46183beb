//! The image loss of photographs of which some pixels do not count: its twin against central differences and against the loss of a part
//! alone, and the kernels against the twin.

use std::sync::Arc;

use glam::{DVec3, USizeVec2};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::{Image, PixelMask},
    eval::Target,
    gpu::Device,
    train::{ImageLoss, LossSums, WaveletWeights, twin},
};

use crate::support::{gpu::variants, oracle::relative_l2};

/// An image pair of which some pixels count.
struct Pair {
    size: USizeVec2,
    render: Vec<[f32; 3]>,
    photograph: Vec<[u8; 3]>,
    counts: Vec<bool>,
}

impl Pair {
    /// Noise; no sample that counts is so close to its photograph that L1 has no gradient. A disk and single pixels do not count.
    fn noise(seed: u64, width: usize, height: usize) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        let photograph: Vec<[u8; 3]> = (0..width * height).map(|_| rng.random()).collect();
        let mut sample = |y: u8| loop {
            let x = rng.random_range(-0.1..1.1_f32);
            if (x - f32::from(y) / 255.0).abs() > 0.004 {
                return x;
            }
        };
        let render = photograph.iter().map(|pixel| pixel.map(&mut sample)).collect();
        let counts = (0..width * height).map(|pixel| {
            let (x, y) = ((pixel % width) as f64, (pixel / width) as f64);
            let from_center = (x - 0.4 * width as f64).hypot(y - 0.4 * height as f64);
            from_center > 0.25 * width.min(height) as f64 && pixel % 7 != 3
        });
        Self { size: USizeVec2::new(width, height), render, counts: counts.collect(), photograph }
    }

    fn render(&self) -> Vec<DVec3> {
        self.render.iter().map(|pixel| DVec3::from(pixel.map(f64::from))).collect()
    }

    fn photograph(&self) -> Vec<DVec3> {
        self.photograph.iter().map(|pixel| DVec3::from(pixel.map(f64::from)) / 255.0).collect()
    }

    fn counted(&self) -> usize {
        self.counts.iter().filter(|counts| **counts).count()
    }

    /// The photograph's words, of which those that do not count have any color.
    fn words(&self) -> Vec<u32> {
        let pixels = self.photograph.iter().zip(&self.counts);
        pixels
            .map(|([r, g, b], counts)| u32::from_le_bytes([*r, *g, *b, if *counts { 255 } else { 0 }]))
            .collect()
    }
}

fn loss_of([ssim, l1, mse]: [f64; 3]) -> f64 {
    LossSums { ssim, l1, mse, wavelet: 0.0 }.loss()
}

#[test]
fn the_twins_gradient_is_that_of_its_loss() {
    for (width, height) in [(13, 17), (5, 3)] {
        let pair = Pair::noise(1, width, height);
        let (render, photograph) = (pair.render(), pair.photograph());
        let (_, gradient) = twin::masked_image_loss(pair.size, &render, &photograph, &pair.counts);
        let share = pair.counted() as f64 / pair.counts.len() as f64;
        for (pixel, found) in gradient.iter().enumerate() {
            for channel in 0..3 {
                let at = |by: f64| {
                    let mut render = render.clone();
                    render[pixel][channel] += by;
                    share * loss_of(twin::masked_image_loss(pair.size, &render, &photograph, &pair.counts).0)
                };
                let expected = (at(1e-5) - at(-1e-5)) / 2e-5;
                let error = (found[channel] - expected).abs();
                assert!(error < 1e-8 + 1e-6 * expected.abs(), "{width}x{height} {pixel} {found} {expected}");
                assert!(pair.counts[pixel] || found[channel] == 0.0, "what is ignored has no gradient");
            }
        }
    }
}

#[test]
fn what_does_not_count_is_as_outside_of_the_image() {
    let whole = Pair::noise(2, 24, 14);
    let counts: Vec<bool> = (0..24 * 14).map(|pixel| pixel % 24 < 11).collect();
    let (sums, gradient) = twin::masked_image_loss(whole.size, &whole.render(), &whole.photograph(), &counts);
    let part = |image: Vec<DVec3>| -> Vec<DVec3> {
        image.chunks_exact(24).flat_map(|row| row[..11].to_vec()).collect()
    };
    let size = USizeVec2::new(11, 14);
    let (expected_sums, expected) = twin::image_loss(size, &part(whole.render()), &part(whole.photograph()));
    assert!(sums.iter().zip(expected_sums).all(|(a, b)| (a - b).abs() < 1e-12), "{sums:?} {expected_sums:?}");
    let scaled = part(gradient).into_iter().map(|v| v * 24.0 / 11.0);
    assert!(scaled.zip(&expected).all(|(a, b)| (a - b).abs().max_element() < 1e-12));
}

/// Sums and gradient from the device; the alpha of the render is NaN.
fn on(
    device: &Device,
    loss: &mut ImageLoss,
    pair: &Pair,
    words: &[u32],
    wavelet: Option<&WaveletWeights>,
) -> (LossSums, Vec<[f32; 4]>) {
    let render: Vec<[f32; 4]> = pair.render.iter().map(|[r, g, b]| [*r, *g, *b, f32::NAN]).collect();
    let render = device.upload("render", &render).expect("a buffer");
    let words = device.upload("photograph", words).expect("a buffer");
    let mut recorder = device.recorder("loss");
    let size = [pair.size.x as u32, pair.size.y as u32];
    let photograph = (&words, pair.counted());
    let gradient =
        loss.record_counted(&mut recorder, size, &render, photograph, wavelet).expect("recorded").clone();
    recorder.submit().expect("submitted");
    (loss.sums().expect("read").expect("a loss"), device.read(&gradient).expect("read"))
}

fn flat(gradient: &[[f32; 4]]) -> Vec<f64> {
    gradient.iter().flat_map(|p| [p[0], p[1], p[2]]).map(f64::from).collect()
}

fn assert_matches_twin(device: &Arc<Device>, loss: &mut ImageLoss, pair: &Pair) {
    let (sums, gradient) = on(device, loss, pair, &pair.words(), None);
    let ([ssim, l1, mse], expected) =
        twin::masked_image_loss(pair.size, &pair.render(), &pair.photograph(), &pair.counts);
    assert!((sums.ssim - ssim).abs() < 1e-5, "{}: SSIM {} {ssim}", pair.size, sums.ssim);
    assert!((sums.l1 - l1).abs() < 1e-6 && (sums.mse - mse).abs() < 1e-6, "{}", pair.size);
    let expected: Vec<f64> = expected.iter().flat_map(|p| p.to_array()).collect();
    let error = relative_l2(&flat(&gradient), &expected);
    assert!(error < 1e-5, "{}: {error:e}", pair.size);
    let ignored = gradient.iter().zip(&pair.counts).filter(|(_, counts)| !**counts);
    assert!(ignored.map(|(pixel, _)| pixel).flatten().all(|v| *v == 0.0), "what is ignored has no gradient");
}

#[test]
fn the_masked_loss_matches_the_twin_however_an_image_is_divided() {
    for device in variants() {
        let mut loss = ImageLoss::masked(Arc::clone(&device)).expect("the kernels");
        for (width, height) in [(13, 17), (64, 65), (270, 9), (16, 16), (3, 5)] {
            assert_matches_twin(&device, &mut loss, &Pair::noise(width as u64, width, height));
        }
    }
    let [device, _] = variants();
    let mut loss = ImageLoss::masked_with_run(Arc::clone(&device), 8).expect("the kernels");
    assert_matches_twin(&device, &mut loss, &Pair::noise(5, 70, 33));
}

#[test]
fn no_bit_depends_on_what_is_ignored_and_none_changes_where_all_counts() {
    let weights = WaveletWeights::at(0.5);
    for device in variants() {
        let mut loss = ImageLoss::masked(Arc::clone(&device)).expect("the kernels");
        let mut pair = Pair::noise(8, 41, 38);
        let words = pair.words();
        let found = on(&device, &mut loss, &pair, &words, Some(&weights));
        let painted: Vec<u32> =
            words.iter().map(|word| if word >> 24 == 0 { 0x00_ff_12 } else { *word }).collect();
        let ignored = pair.render.iter_mut().zip(&pair.counts).filter(|(_, counts)| !**counts);
        ignored.for_each(|(pixel, _)| *pixel = [7.0, -3.0, 0.5]);
        assert!(on(&device, &mut loss, &pair, &painted, Some(&weights)) == found);
        pair.counts.fill(true);
        let mut plain = ImageLoss::new(Arc::clone(&device)).expect("the kernels");
        let whole = on(&device, &mut plain, &pair, &pair.words(), Some(&weights));
        let masked = on(&device, &mut loss, &pair, &pair.words(), Some(&weights));
        assert!((whole.0.loss() - masked.0.loss()).abs() < 1e-6);
        assert!(relative_l2(&flat(&masked.1), &flat(&whole.1)) < 1e-6);
    }
}

#[test]
fn the_wavelet_constraint_sees_no_difference_where_pixels_do_not_count() {
    let weights = WaveletWeights::at(0.5);
    let pair = Pair::noise(9, 37, 22);
    let at = |image: Vec<DVec3>| -> Vec<DVec3> {
        image.iter().zip(&pair.counts).map(|(v, counts)| if *counts { *v } else { DVec3::ZERO }).collect()
    };
    let (loss, mut by_wavelet) =
        twin::wavelet(pair.size, &at(pair.render()), &at(pair.photograph()), &weights);
    by_wavelet = at(by_wavelet);
    let (_, by_image) = twin::masked_image_loss(pair.size, &pair.render(), &pair.photograph(), &pair.counts);
    let expected: Vec<f64> = by_wavelet.iter().zip(&by_image).flat_map(|(a, b)| (a + b).to_array()).collect();
    for device in variants() {
        let mut masked = ImageLoss::masked(Arc::clone(&device)).expect("the kernels");
        let (sums, gradient) = on(&device, &mut masked, &pair, &pair.words(), Some(&weights));
        let share = pair.counted() as f64 / pair.counts.len() as f64;
        assert!((sums.wavelet * share - loss).abs() < 1e-6, "{} {loss}", sums.wavelet);
        assert!(relative_l2(&flat(&gradient), &expected) < 1e-5);
    }
}

#[test]
fn the_final_figures_are_those_of_the_loss() {
    let photograph = Pair::noise(6, 40, 26);
    let rendered: Vec<[u8; 3]> =
        photograph.photograph.iter().map(|p| p.map(|v| v.saturating_add(23) ^ 1)).collect();
    let image = |samples: &[[u8; 3]]| Image::new(40, 26, 3, samples.concat()).expect("an image");
    let mask = PixelMask::from_fn(40, 26, |x, y| photograph.counts[(y * 40 + x) as usize]);
    let target = Target::new(image(&photograph.photograph), Some(mask));
    let score = target.score("a", &image(&rendered)).expect("comparable");
    let render = rendered.iter().map(|pixel| pixel.map(|v| f32::from(v) / 255.0)).collect();
    let pair = Pair { render, ..photograph };
    let ([ssim, _, mse], _) =
        twin::masked_image_loss(pair.size, &pair.render(), &pair.photograph(), &pair.counts);
    assert!((score.ssim - ssim).abs() < 1e-6, "{} {ssim}", score.ssim);
    assert!((score.psnr + 10.0 * mse.log10()).abs() < 1e-4, "{} {mse}", score.psnr);
}
