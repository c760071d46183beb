//! Figures for the record: bytes against the ideal, seconds. Run in release with
//! `cargo test --release --package tcgs-codec --test it figures -- --ignored --nocapture`.

use std::time::Instant;

use tcgs_codec::{DecodeLimits, decode, encode, inspect};

use super::synthetic::{Recipe, feature_sigma, scene, settings};

/// Bits of an integer under a discretised normal distribution.
fn bits(symbol: f64, mean: f64, sigma: f64) -> f64 {
    let cumulative = |x: f64| 0.5 * libm::erfc(-(x - mean) / sigma / std::f64::consts::SQRT_2);
    // The tail with the smaller cancellation.
    let distance = (symbol - mean).abs();
    let mass = cumulative(mean - distance + 0.5) - cumulative(mean - distance - 0.5);
    -mass.max(f64::MIN_POSITIVE).log2()
}

#[test]
fn features_and_offsets_are_within_a_half_percent_of_the_ideal() {
    let ratio = ratios(6000);
    assert!(ratio.0 < 1.005, "features take {} of the ideal", ratio.0);
    assert!(ratio.1 < 1.005, "offsets take {} of the ideal", ratio.1);
}

/// Bytes of features and offsets against the distributions that they were drawn from.
fn ratios(anchors: usize) -> (f64, f64) {
    let (f, k) = (32, 10);
    let scene = scene(Recipe { seed: 77, anchors, feature_dim: f, offsets: k, masked: 0.4 });
    let started = Instant::now();
    let encoded = encode(&scene, None, &settings()).expect("encodes");
    let encode_seconds = started.elapsed().as_secs_f64();
    let started = Instant::now();
    let decoded = decode(&encoded.bytes, &DecodeLimits::default()).expect("decodes");
    let decode_seconds = started.elapsed().as_secs_f64();

    let features: f64 = decoded
        .scene
        .features
        .iter()
        .enumerate()
        .map(|(index, value)| bits(f64::from(*value), 0.0, feature_sigma(index % f)))
        .sum();
    let offsets: f64 = decoded
        .scene
        .offsets
        .chunks(3)
        .zip(&decoded.scene.masks)
        .filter(|(_, kept)| **kept)
        .flat_map(|(offset, _)| offset)
        .map(|value| bits((f64::from(*value) / 0.2).round(), 0.0, 5.0))
        .sum();
    let counts = &encoded.byte_counts;
    let ratio = (counts.features as f64 * 8.0 / features, counts.offsets as f64 * 8.0 / offsets);
    println!("{}", inspect(&encoded.bytes).expect("inspects"));
    println!("encode {encode_seconds:.3} s (with its own decode), decode {decode_seconds:.3} s");
    println!("features {:.5} and offsets {:.5} of the ideal", ratio.0, ratio.1);
    ratio
}

#[test]
#[ignore = "prints figures for 20 000 anchors"]
fn figures() {
    ratios(20_000);
}
