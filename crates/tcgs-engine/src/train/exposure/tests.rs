//! Color corrections: kernels against their twins, and twins against central differences.

use std::sync::Arc;

use glam::{DVec3, DVec4, USizeVec2};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::*;
use crate::{
    gpu::{Device, testing::lavapipe},
    train::{
        LossSums, WaveletWeights,
        checkpoint::ModelState,
        twin::{self, AdamElement},
    },
};

#[test]
fn a_photograph_with_few_visits_learns_faster() {
    let start = |visits| learning_rates(visits).start;
    assert_eq!([1.0, 60.0, 1000.0].map(start), [0.1, 0.05, 0.01]);
    let at = |number| Learning::at(number, 300, 2, 5);
    assert_eq!([1, 5, 6, 300].map(|number| at(number).visit), [1, 1, 2, 60]);
    assert!((at(300).learning_rate - 0.005).abs() < 1e-12);
    assert_eq!(at(1).photograph, 2);
}

fn random_rows(rng: &mut Pcg64) -> [[f32; 4]; 3] {
    let mut rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    rows.iter_mut().flatten().for_each(|value| *value += rng.random_range(-0.3..0.3_f32));
    rows
}

fn exact(rows: &[[f32; 4]; 3]) -> [DVec4; 3] {
    rows.map(|row| DVec4::from(row.map(f64::from)))
}

fn pixels(rng: &mut Pcg64, count: usize) -> Vec<[f32; 4]> {
    (0..count).map(|_| [0; 4].map(|_| rng.random_range(0.0..1.0_f32))).collect()
}

fn colors(pixels: &[[f32; 4]]) -> Vec<DVec3> {
    pixels.iter().map(|p| DVec3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]))).collect()
}

fn differ(found: &[DVec3], expected: &[DVec3]) -> f64 {
    assert_eq!(found.len(), expected.len());
    found.iter().zip(expected).map(|(a, b)| (a - b).abs().max_element()).fold(0.0, f64::max)
}

/// Corrections of these values, with moments of zero.
fn corrections_of(device: &Arc<Device>, rows: &[[[f32; 4]; 3]]) -> ColorCorrections {
    let made = ColorCorrections::new(device, rows.len()).expect("the kernels");
    let mut state = ModelState::default();
    made.save(&mut state).expect("read");
    let _: Vec<f32> = state.take("corrections").expect("there");
    state.put("corrections", rows.iter().flatten().flatten().copied().collect::<Vec<f32>>());
    made.restore(&mut state).expect("restored");
    state.finish().expect("nothing is left");
    made
}

/// How far the mean of the corrections is from the identity.
pub(in crate::train) fn distance_of_mean(corrections: &[[[f32; 4]; 3]]) -> f64 {
    let mean = |row: usize, column: usize| {
        let sum: f64 = corrections.iter().map(|rows| f64::from(rows[row][column])).sum();
        sum / corrections.len() as f64
    };
    let places = (0..3).flat_map(|row| (0..4).map(move |column| (row, column)));
    let away = places.map(|(row, column)| (mean(row, column) - f64::from(u8::from(row == column))).abs());
    away.fold(0.0, f64::max)
}

#[test]
fn kernels_follow_their_twins() {
    const COUNT: usize = 70;
    let device = lavapipe();
    let mut rng = Pcg64::seed_from_u64(3);
    let rows: Vec<_> = (0..COUNT).map(|_| random_rows(&mut rng)).collect();
    let mut corrections = corrections_of(&device, &rows);
    let element = |value: f32| AdamElement { value: f64::from(value), ..AdamElement::default() };
    let mut expected: Vec<_> = rows.iter().map(|rows| rows.map(|row| row.map(element))).collect();
    for (visit, count) in [(1, 37 * 61), (2, 1), (3, 1024), (4, 5000)] {
        let (render, d) = (pixels(&mut rng, count), pixels(&mut rng, count));
        let learning = Learning { photograph: 11 * visit as usize, visit, learning_rate: 0.02 };
        let before = corrections.read().expect("read");
        let own = exact(&before[learning.photograph]);
        let (by_render, by_rows) = twin::correct_colors_gradient(&own, &colors(&render), &colors(&d));
        let render_buffer = device.upload("render", &render).expect("a buffer");
        // A pass that overflowed first, of which nothing stays.
        for overflow in [1_u32, 0] {
            let flag = device.upload("overflow flag", &[overflow]).expect("a buffer");
            let d_image = device.upload("gradient", &d).expect("a buffer");
            let mut recorder = device.recorder("corrections");
            let corrected = corrections.correct(&mut recorder, learning.photograph, &render_buffer, count);
            let corrected = corrected.expect("recorded");
            corrections.learn(&mut recorder, learning, &render_buffer, &d_image, &flag).expect("recorded");
            recorder.submit().expect("submitted");
            let found = colors(&device.read(&corrected).expect("read"));
            assert!(differ(&found, &twin::correct_colors(&own, &colors(&render))) < 1e-6);
            assert!(differ(&colors(&device.read(&d_image).expect("read")), &by_render) < 1e-6);
            let after = corrections.read().expect("read");
            assert_eq!(after == before, overflow == 1, "{visit}");
        }
        twin::correction_step(&mut expected, learning.photograph, visit, 0.02, &by_rows);
        let found = corrections.read().expect("read");
        for (found, expected) in found.iter().zip(&expected) {
            for (found, expected) in found.iter().flatten().zip(expected.iter().flatten()) {
                assert!((f64::from(*found) - expected.value).abs() < 2e-6, "{found} {}", expected.value);
            }
        }
        assert!(distance_of_mean(&found) < 1e-6, "{}", distance_of_mean(&found));
    }
}

#[test]
fn a_gradient_that_is_not_finite_changes_no_correction() {
    let device = lavapipe();
    let mut corrections = ColorCorrections::new(&device, 2).expect("the kernels");
    let render = device.upload("render", &[[0.5_f32; 4]; 3]).expect("a buffer");
    let d_image = device.upload("gradient", &[[f32::NAN; 4], [1.0; 4], [1.0; 4]]).expect("a buffer");
    let flag = device.upload("overflow flag", &[0_u32]).expect("a buffer");
    let before = corrections.read().expect("read");
    let mut recorder = device.recorder("corrections");
    corrections.correct(&mut recorder, 1, &render, 3).expect("recorded");
    let learning = Learning { photograph: 1, visit: 1, learning_rate: 0.1 };
    corrections.learn(&mut recorder, learning, &render, &d_image, &flag).expect("recorded");
    recorder.submit().expect("submitted");
    assert_eq!(corrections.read().expect("read"), before);
}

/// The loss of a step that has everything: pixels that do not count, L1, SSIM and wavelet bands.
struct Photo {
    size: USizeVec2,
    photograph: Vec<DVec3>,
    counts: Vec<bool>,
    weights: WaveletWeights,
}

impl Photo {
    /// The loss and its gradient by the corrected render.
    fn loss(&self, corrected: &[DVec3]) -> (f64, Vec<DVec3>) {
        let Self { size, photograph, counts, weights } = self;
        let share = counts.iter().filter(|counts| **counts).count() as f64 / counts.len() as f64;
        let ([ssim, l1, mse], d_image) = twin::masked_image_loss(*size, corrected, photograph, counts);
        let seen = |image: &[DVec3]| -> Vec<DVec3> {
            image.iter().zip(counts).map(|(p, counts)| if *counts { *p } else { DVec3::ZERO }).collect()
        };
        let (wavelet, d_wavelet) = twin::wavelet(*size, &seen(corrected), &seen(photograph), weights);
        let loss = share * LossSums { ssim, l1, mse, wavelet: 0.0 }.loss() + wavelet;
        let d = d_image.iter().zip(seen(&d_wavelet)).map(|(a, b)| a + b).collect();
        (loss, d)
    }
}

#[test]
fn the_gradient_by_corrections_and_render_is_that_of_the_whole_loss() {
    let size = USizeVec2::new(13, 9);
    let count = size.x * size.y;
    let mut rng = Pcg64::seed_from_u64(5);
    let render = colors(&pixels(&mut rng, count));
    let photo = Photo {
        size,
        photograph: colors(&pixels(&mut rng, count)),
        counts: (0..count).map(|pixel| pixel % 5 != 2 && pixel % size.x < 10).collect(),
        weights: WaveletWeights::at(0.6),
    };
    let rows = exact(&random_rows(&mut rng));
    let loss_of = |rows: &[DVec4; 3], render: &[DVec3]| photo.loss(&twin::correct_colors(rows, render)).0;
    let (_, d_corrected) = photo.loss(&twin::correct_colors(&rows, &render));
    let (by_render, by_rows) = twin::correct_colors_gradient(&rows, &render, &d_corrected);
    let close = |found: f64, of: &dyn Fn(f64) -> f64| {
        let expected = (of(1e-6) - of(-1e-6)) / 2e-6;
        assert!((found - expected).abs() < 1e-7 + 1e-5 * expected.abs(), "{found} {expected}");
    };
    for row in 0..3 {
        for column in 0..4 {
            close(by_rows[row][column], &|by| {
                let mut rows = rows;
                rows[row][column] += by;
                loss_of(&rows, &render)
            });
        }
    }
    for pixel in (0..count).step_by(7) {
        for channel in 0..3 {
            close(by_render[pixel][channel], &|by| {
                let mut render = render.clone();
                render[pixel][channel] += by;
                loss_of(&rows, &render)
            });
        }
        assert!(photo.counts[pixel] || by_render[pixel] == DVec3::ZERO);
    }
}

#[test]
fn corrections_without_visits_change_no_color() {
    let device = lavapipe();
    let mut rng = Pcg64::seed_from_u64(9);
    let image = pixels(&mut rng, 300);
    let render = device.upload("render", &image).expect("a buffer");
    let mut corrections = ColorCorrections::new(&device, 3).expect("the kernels");
    let mut recorder = device.recorder("corrections");
    let corrected = corrections.correct(&mut recorder, 2, &render, 300).expect("recorded");
    recorder.submit().expect("submitted");
    assert_eq!(colors(&device.read(&corrected).expect("read")), colors(&image));
}
