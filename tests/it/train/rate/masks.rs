//! Masks weigh their offsets' bits: the twin against central differences, the kernel against the twin.

use tcgs::train::{Adam, AdamStep, MaskRows, OffsetMasks, context::QuantizationPhase, twin};

use super::scene::{Case, LAMBDA, OnDevice, SMALL, f64s, quantization};
use crate::support::{gpu::gpu, oracle::relative_l2};

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

#[test]
fn the_twins_gradient_is_that_of_bits_times_logistics() {
    let (logits, bits, weight) = ([1.0, -2.0, 0.3], [12.0, 0.0, 3.5], 0.7);
    let mut found = [0.1; 3];
    twin::mask_rate(&logits, &bits, weight, &mut found);
    for k in 0..3 {
        let at = |by: f64| weight * bits[k] * logistic(logits[k] + by);
        let expected = 0.1 + (at(1e-6) - at(-1e-6)) / 2e-6;
        assert!((found[k] - expected).abs() < 1e-9, "{} {expected}", found[k]);
    }
}

/// The logits after the first step of Adam, which moves each against the sign of its gradient, do not tell sizes; so the
/// first moments are read, a tenth of the gradients.
#[test]
fn the_kernel_adds_the_rates_gradient_for_the_sampled_anchors() {
    const COUNT: usize = 90;
    let device = gpu();
    let case = Case::random(51, SMALL, COUNT, 33);
    let uploaded = OnDevice::upload(&device, &case, &vec![0.0; COUNT * SMALL.row()]);
    uploaded.run(&device, &quantization(QuantizationPhase::Noise));
    let offsets = COUNT * SMALL.offsets;
    let logits: Vec<f32> = (0..offsets).map(|i| (i % 13) as f32 * 0.5 - 4.0).collect();
    let rows = MaskRows { logits: logits.clone(), ..MaskRows::new(offsets) };
    let masks = OffsetMasks::upload(&device, SMALL, &rows).expect("room");
    let mut recorder = device.recorder("masks");
    masks.rate_backward(&mut recorder, &uploaded.rate, uploaded.sample(), LAMBDA).expect("recorded");
    let adam = Adam::new(&device).expect("adam");
    masks
        .step(
            &mut recorder,
            &adam,
            AdamStep { number: 1, overflow_flag: &uploaded.overflow_flag },
            0.01,
            -4.6,
            &uploaded.anchors,
        )
        .expect("recorded");
    recorder.submit().expect("submitted");
    let found: Vec<f64> =
        masks.read(&device).expect("read").first.iter().map(|v| 10.0 * f64::from(*v)).collect();
    let weight = f64::from(uploaded.rate.weight(LAMBDA, 33));
    let mut expected = vec![0.0; offsets];
    let bits = uploaded.bits(&device);
    for (place, anchor) in case.sample.iter().map(|anchor| *anchor as usize).enumerate() {
        let range = anchor * SMALL.offsets..(anchor + 1) * SMALL.offsets;
        let of_offsets: Vec<f64> = (0..SMALL.offsets).map(|k| bits[3 + k][place]).collect();
        twin::mask_rate(&f64s(&logits[range.clone()]), &of_offsets, weight, &mut expected[range]);
    }
    assert!(expected.iter().filter(|d| **d > 0.0).count() > 33);
    assert!(relative_l2(&found, &expected) < 1e-5);
}
