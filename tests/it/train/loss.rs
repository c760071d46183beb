//! The image loss: its twin against central differences, the kernels against the twin, and SSIM against the final metric's
//! and a plain two-dimensional window.

use std::sync::Arc;

use glam::{DVec3, USizeVec2};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::Image,
    eval,
    gpu::{Device, DeviceSettings, KernelVariant},
    train::{ImageLoss, LossSums, twin},
};

use crate::support::{
    gpu::{gpu, gpu_with, variants},
    oracle::relative_l2,
};

/// An image pair: the render in f32, the photograph in 8 bits.
struct Pair {
    size: USizeVec2,
    render: Vec<[f32; 3]>,
    photograph: Vec<[u8; 3]>,
}

impl Pair {
    /// Noise. No sample is closer than 0.004 to its photograph: there the L1 part has no gradient.
    fn noise(seed: u64, width: usize, height: usize) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        let photograph: Vec<[u8; 3]> = (0..width * height).map(|_| rng.random()).collect();
        let mut render = |y: u8| loop {
            let x = rng.random_range(-0.1..1.1_f32);
            if (x - f32::from(y) / 255.0).abs() > 0.004 {
                return x;
            }
        };
        let render = photograph.iter().map(|pixel| pixel.map(&mut render)).collect();
        Self { size: USizeVec2::new(width, height), render, photograph }
    }

    /// A gradient and the same gradient moved, as photographs of walls and skies are.
    fn smooth(width: usize, height: usize) -> Self {
        let at =
            |pixel: usize| (pixel % width) as f32 / width as f32 + (pixel / width) as f32 / height as f32;
        let photograph = (0..width * height)
            .map(|pixel| [60.0 * at(pixel), 200.0 - 40.0 * at(pixel), 120.0].map(|v| v as u8));
        let render =
            (0..width * height).map(|pixel| [0.25 * at(pixel) + 0.011, 0.8 - 0.171 * at(pixel), 0.467]);
        Self {
            size: USizeVec2::new(width, height),
            render: render.collect(),
            photograph: photograph.collect(),
        }
    }

    fn render(&self) -> Vec<DVec3> {
        self.render.iter().map(|pixel| DVec3::from(pixel.map(f64::from))).collect()
    }

    fn photograph(&self) -> Vec<DVec3> {
        self.photograph.iter().map(|pixel| DVec3::from(pixel.map(f64::from)) / 255.0).collect()
    }
}

fn loss_of(sums: [f64; 3]) -> f64 {
    LossSums { ssim: sums[0], l1: sums[1], mse: sums[2], wavelet: 0.0 }.loss()
}

#[test]
fn the_twins_gradient_is_that_of_its_loss() {
    for (width, height) in [(13, 17), (3, 5), (1, 1), (11, 2)] {
        let pair = Pair::noise(1, width, height);
        let (render, photograph) = (pair.render(), pair.photograph());
        let (_, gradient) = twin::image_loss(pair.size, &render, &photograph);
        for (pixel, found) in gradient.iter().enumerate() {
            for channel in 0..3 {
                let at = |by: f64| {
                    let mut render = render.clone();
                    render[pixel][channel] += by;
                    loss_of(twin::image_loss(pair.size, &render, &photograph).0)
                };
                let expected = (at(1e-5) - at(-1e-5)) / 2e-5;
                // A loss of order one: the difference is good to 1e-11 by rounding and 1e-9 by curvature.
                let error = (found[channel] - expected).abs();
                assert!(error < 1e-8 + 1e-6 * expected.abs(), "{width}x{height} {pixel} {found} {expected}");
            }
        }
    }
}

#[test]
fn the_twin_of_the_tiles_is_that_of_rows_and_columns() {
    for (width, height) in [(33, 18), (3, 5), (1, 1)] {
        let pair = Pair::noise(2, width, height);
        let (render, photograph) = (pair.render(), pair.photograph());
        let samples = (3 * render.len()) as f64;
        let (derivatives, losses) = twin::ssim_tiles(pair.size, &render, &photograph);
        let weights = [0.8 / samples, 0.2 / samples];
        let gradient = twin::image_gradient_tiles(pair.size, &render, &photograph, &derivatives, weights);
        let sums = twin::sum_losses(&losses).map(|sum| sum / samples);
        let (expected_sums, expected) = twin::image_loss(pair.size, &render, &photograph);
        let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
        assert!(sums.iter().zip(expected_sums).all(|(a, b)| near(*a, b)), "{sums:?} {expected_sums:?}");
        assert!(gradient.iter().zip(&expected).all(|(a, b)| (a - b).abs().max_element() < 1e-12));
    }
}

/// A device of its own for each variant of the kernels.
fn fresh_variants() -> [Arc<Device>; 2] {
    [KernelVariant::Software, KernelVariant::Hardware]
        .map(|variant| gpu_with(DeviceSettings { variant: Some(variant), ..DeviceSettings::default() }))
}

fn loss_on(device: &Arc<Device>) -> ImageLoss {
    ImageLoss::new(Arc::clone(device)).expect("the kernels")
}

/// Sums and gradient from the device; what the kernels must not read is NaN or noise.
fn on(device: &Device, loss: &mut ImageLoss, pair: &Pair) -> (LossSums, Vec<[f32; 4]>) {
    let render: Vec<[f32; 4]> = pair.render.iter().map(|[r, g, b]| [*r, *g, *b, f32::NAN]).collect();
    let render = device.upload("render", &render).expect("a buffer");
    let packed: Vec<u32> =
        pair.photograph.iter().map(|[r, g, b]| u32::from_le_bytes([*r, *g, *b, r ^ b])).collect();
    let packed = device.upload("photograph", &packed).expect("a buffer");
    let mut recorder = device.recorder("loss");
    let size = [pair.size.x as u32, pair.size.y as u32];
    let gradient = loss.record(&mut recorder, size, &render, &packed, None).expect("recorded").clone();
    recorder.submit().expect("submitted");
    (loss.sums().expect("read").expect("a loss"), device.read(&gradient).expect("read"))
}

fn assert_matches_twin(device: &Device, loss: &mut ImageLoss, pair: &Pair, bound: f64) {
    let (sums, gradient) = on(device, loss, pair);
    let ([ssim, l1, mse], expected) = twin::image_loss(pair.size, &pair.render(), &pair.photograph());
    assert!((sums.ssim - ssim).abs() < bound, "{}: SSIM {} {ssim}", pair.size, sums.ssim);
    assert!((sums.l1 - l1).abs() < 1e-6 && (sums.mse - mse).abs() < 1e-6, "{}", pair.size);
    let found: Vec<f64> = gradient.iter().flat_map(|p| [p[0], p[1], p[2]]).map(f64::from).collect();
    let expected: Vec<f64> = expected.iter().flat_map(|p| p.to_array()).collect();
    let error = relative_l2(&found, &expected);
    assert!(error < bound, "{}: {error:e}", pair.size);
    assert!(gradient.iter().all(|pixel| pixel[3] == 0.0), "there is no gradient by alpha");
}

#[test]
fn the_loss_matches_the_twin_whatever_the_size() {
    for device in variants() {
        let mut loss = loss_on(&device);
        assert!(loss.sums().expect("nothing to read").is_none(), "no figures before the first loss");
        // Sizes shrink and grow in one instance. Some are more than one run of an invocation, some whole tiles, some not.
        let sizes =
            [(13, 17), (3, 5), (64, 65), (1, 1), (1, 40), (32, 48), (270, 3), (5, 259), (16, 16), (13, 17)];
        for (width, height) in sizes {
            let pair = Pair::noise((width * height) as u64, width, height);
            assert_matches_twin(&device, &mut loss, &pair, 1e-5);
        }
    }
}

#[test]
fn the_gradient_is_that_of_the_loss_on_the_device() {
    // No sample is closer than this to its photograph, so L1 has no kink in between.
    const STEP: f32 = 0.003;
    for device in variants() {
        let mut loss = loss_on(&device);
        for (seed, (width, height)) in [(1, (35, 21)), (2, (16, 16)), (3, (7, 40))] {
            let pair = Pair::noise(seed, width, height);
            let (_, gradient) = on(&device, &mut loss, &pair);
            let mut rng = Pcg64::seed_from_u64(seed);
            // Mostly uphill, so that the slope is far from zero.
            let direction: Vec<[f32; 3]> = gradient
                .iter()
                .map(|g| {
                    [0, 1, 2].map(|c| rng.random_range(0.2..1.0_f32) * if g[c] > 0.0 { 1.0 } else { -1.0 })
                })
                .collect();
            let expected: f64 = gradient
                .iter()
                .zip(&direction)
                .flat_map(|(g, d)| [0, 1, 2].map(|c| f64::from(g[c]) * f64::from(d[c])))
                .sum();
            let mut at = |step: f32| {
                let moved = pair.render.iter().zip(&direction);
                let render = moved.map(|(x, d)| [0, 1, 2].map(|c| x[c] + step * d[c])).collect();
                let moved = Pair { size: pair.size, render, photograph: pair.photograph.clone() };
                on(&device, &mut loss, &moved).0.loss()
            };
            let found = (at(STEP) - at(-STEP)) / (2.0 * f64::from(STEP));
            // Rounding of 1e-7 of the loss over a difference of 4e-3, and the curvature of SSIM.
            assert!((found / expected - 1.0).abs() < 5e-3, "{:?}: {found} {expected}", device.variant());
        }
    }
}

#[test]
fn alternating_image_sizes_make_no_buffers_and_change_no_bits() {
    let pairs = [(70, 61), (61, 70), (13, 130), (3, 5)].map(|(width, height)| Pair::noise(7, width, height));
    for (device, other) in fresh_variants().iter().zip(&variants()) {
        let mut loss = loss_on(device);
        let mut made = |pair: &Pair| {
            let before = (device.buffers_made(), device.allocated_bytes());
            let found = on(device, &mut loss, pair);
            let fresh = on(other, &mut loss_on(other), pair);
            assert!(found == fresh, "{}", pair.size);
            (device.buffers_made() - before.0, device.allocated_bytes() - before.1)
        };
        for pair in &pairs {
            made(pair);
        }
        let again = made(&pairs[3]);
        for pair in pairs.iter().chain(&pairs) {
            assert_eq!(made(pair), again, "{}", pair.size);
        }
    }
}

#[test]
fn the_loss_matches_the_twin_however_an_image_is_divided() {
    let [device, _] = variants();
    for run in [4, 8, 16, 64] {
        let mut loss = ImageLoss::with_run(Arc::clone(&device), run).expect("the kernels");
        // 130 x 70 has more shares of the loss than one run of the sum, where runs are short.
        for (width, height) in [(130, 70), (16, 16), (17, 15), (1, 33), (40, 1)] {
            let pair = Pair::noise((width * height) as u64, width, height);
            assert_matches_twin(&device, &mut loss, &pair, 1e-5);
        }
    }
}

/// As of upright photographs of three megapixels where 128 MiB are bound.
#[test]
fn channels_that_fit_only_one_at_a_time_give_the_same_bits() {
    for unbound in variants() {
        let pair = Pair::noise(6, 97, 65);
        let whole = on(&unbound, &mut loss_on(&unbound), &pair);
        let device = gpu_with(DeviceSettings {
            max_binding_bytes: Some(200_000),
            variant: Some(unbound.variant()),
            ..DeviceSettings::default()
        });
        let mut loss = loss_on(&device);
        assert!(on(&device, &mut loss, &pair) == whole);
        // Smaller images go at once, larger ones again in parts.
        let small = Pair::noise(8, 40, 30);
        let expected = on(&unbound, &mut loss_on(&unbound), &small);
        assert!(on(&device, &mut loss, &small) == expected);
        assert!(on(&device, &mut loss, &pair) == whole);
    }
}

#[test]
fn the_loss_matches_the_twin_on_smooth_images() {
    // Where an image hardly varies, the variance is a difference of nearly equal numbers: 6e-8 of rounding against SSIM's
    // constant of 9e-4, times a few. It enters only with the variance of the images' difference, which is small here.
    for device in variants() {
        assert_matches_twin(&device, &mut loss_on(&device), &Pair::smooth(60, 44), 1e-4);
    }
}

#[test]
fn the_same_images_give_the_same_bits() {
    let pair = Pair::noise(3, 97, 65);
    let bits = |(sums, gradient): (LossSums, Vec<[f32; 4]>)| {
        let gradient: Vec<u32> = gradient.iter().flatten().map(|v| v.to_bits()).collect();
        ([sums.ssim, sums.l1, sums.mse].map(f64::to_bits), gradient)
    };
    for device in variants() {
        let mut loss = loss_on(&device);
        let first = bits(on(&device, &mut loss, &pair));
        on(&device, &mut loss, &Pair::noise(4, 97, 65));
        assert!(bits(on(&device, &mut loss, &pair)) == first);
    }
}

#[test]
fn equal_images_have_no_loss_and_next_to_no_gradient() {
    let mut pair = Pair::noise(5, 21, 19);
    pair.render = pair.photograph.iter().map(|pixel| pixel.map(|v| f32::from(v) / 255.0)).collect();
    for device in variants() {
        let (sums, gradient) = on(&device, &mut loss_on(&device), &pair);
        assert!(sums.loss().abs() < 1e-6, "{sums:?}");
        assert!(sums.psnr() > 90.0);
        // One sample's weight is 0.8 over 1197 samples, 7e-4; the device's 8-bit decoding may differ in the last bit.
        assert!(gradient.iter().flatten().all(|v| v.abs() < 1e-3));
    }
}

/// SSIM with an 11 x 11 window, pixel by pixel.
fn plain_ssim(a: &Image, b: &Image) -> f64 {
    let (width, height) = (i64::from(a.width()), i64::from(a.height()));
    let bell = |d: i64| (-((d * d) as f64) / 4.5).exp();
    let total: f64 = (-5..=5).flat_map(|v| (-5..=5).map(move |u| bell(u) * bell(v))).sum();
    let mut sum = 0.0;
    for channel in 0..3 {
        let sample = |image: &Image, x: i64, y: i64| {
            f64::from(image.samples()[((y * width + x) * 3 + channel) as usize]) / 255.0
        };
        for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
            let mut moments = [0.0; 5];
            for (v, u) in (-5..=5).flat_map(|v| (-5..=5).map(move |u| (v, u))) {
                if (0..width).contains(&(x + u)) && (0..height).contains(&(y + v)) {
                    let (p, q) = (sample(a, x + u, y + v), sample(b, x + u, y + v));
                    let weight = bell(u) * bell(v) / total;
                    for (moment, value) in moments.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                        *moment += weight * value;
                    }
                }
            }
            let [p, q, pp, qq, pq] = moments;
            let contrast = (2.0 * (pq - p * q) + 9e-4) / (pp - p * p + qq - q * q + 9e-4);
            sum += (2.0 * p * q + 1e-4) / (p * p + q * q + 1e-4) * contrast;
        }
    }
    sum / (3 * width * height) as f64
}

#[test]
fn the_final_metric_the_loss_and_a_plain_window_agree_on_8_bit_images() {
    for (width, height) in [(13, 17), (3, 5), (40, 26)] {
        let photograph = Pair::noise(6, width, height).photograph;
        let mut rng = Pcg64::seed_from_u64(7);
        let mut near = |v: u8| v.saturating_add(rng.random_range(0..40)) ^ 1;
        let rendered: Vec<[u8; 3]> = photograph.iter().map(|pixel| pixel.map(&mut near)).collect();
        let image = |samples: &[[u8; 3]]| {
            Image::new(width as u32, height as u32, 3, samples.concat()).expect("an image")
        };
        let (a, b) = (image(&rendered), image(&photograph));
        let render = rendered.iter().map(|pixel| pixel.map(|v| f32::from(v) / 255.0)).collect();
        let pair = Pair { size: USizeVec2::new(width, height), render, photograph };
        let (on_device, _) = on(&gpu(), &mut loss_on(&gpu()), &pair);
        let ([twin, ..], _) = twin::image_loss(pair.size, &pair.render(), &pair.photograph());
        let metric = eval::ssim(&a, &b).expect("comparable");
        let plain = plain_ssim(&a, &b);
        assert!((metric - plain).abs() < 1e-12, "{metric} {plain}");
        assert!((metric - twin).abs() < 1e-6, "{metric} {twin}: f32 renders against exact 8-bit ones");
        assert!((metric - on_device.ssim).abs() < 1e-5, "{metric} {}", on_device.ssim);
        assert!((eval::psnr(&a, &b).expect("comparable") - on_device.psnr()).abs() < 1e-4);
    }
}
