//! The wavelet constraint over whole bands (TC-GS (6), METHOD.md §4.7).

use glam::{DVec3, USizeVec2};

use crate::{eval::Haar, train::WaveletWeights};

/// The weighted sum of the bands' mean absolute differences, and its gradient by each sample of the render.
#[must_use]
pub fn wavelet(
    size: USizeVec2,
    render: &[DVec3],
    photograph: &[DVec3],
    weights: &WaveletWeights,
) -> (f64, Vec<DVec3>) {
    // Each image's own bands, not those of the difference: what the formula says.
    let (x, y) = (Haar::of(size, render), Haar::of(size, photograph));
    let (x_coarse, y_coarse) = (Haar::of(x.size, &x.low), Haar::of(y.size, &y.low));
    let mut loss = 0.0;
    let mut compare = |x: &[DVec3], y: &[DVec3], weight: f64| -> Vec<DVec3> {
        let share = weight / (3 * x.len()) as f64;
        let difference = |(x, y): (&DVec3, &DVec3)| {
            loss += share * (x - y).abs().element_sum();
            (x - y).map(|v| if v == 0.0 { 0.0 } else { share * v.signum() })
        };
        x.iter().zip(y).map(difference).collect()
    };
    let coarse = Haar {
        size: x_coarse.size,
        low: compare(&x_coarse.low, &y_coarse.low, weights.low),
        high: [0, 1, 2].map(|band| compare(&x_coarse.high[band], &y_coarse.high[band], weights.coarse[band])),
    };
    let fine = Haar {
        size: x.size,
        low: coarse.image(x.size),
        high: [0, 1, 2].map(|band| compare(&x.high[band], &y.high[band], weights.fine[band])),
    };
    let gradient = fine.image(size);
    (loss, gradient)
}
