//! LPIPS against the `lpips` package in f64 on the same random weights, and what it refuses.
//!
//! `tests/oracles/lpips_oracle.py` makes the same weights and images and writes the expected values.

use safetensors::Dtype;
use serde::Deserialize;
use tcgs::domain::{Image, LpipsNetwork, Problem};
use tcgs_lab::lpips::{Lpips, LpipsError};

use crate::support::lpips::{Tensor, as_torchvision_does, file, splitmix, weights};

#[derive(Debug, Deserialize)]
struct Expected {
    net: String,
    width: u32,
    height: u32,
    layers: [f64; 5],
    total: f64,
}

fn expected(net: &str) -> Vec<Expected> {
    let all: Vec<Expected> =
        serde_json::from_str(include_str!("../../oracles/lpips.json")).expect("the values");
    all.into_iter().filter(|expected| expected.net == net).collect()
}

fn named<'a>(tensors: &'a mut [Tensor], name: &str) -> &'a mut Tensor {
    tensors.iter_mut().find(|tensor| tensor.name == name).expect("a tensor of this name")
}

/// The oracle's images: a colored gradient, and the same with every third sample disturbed.
fn images(width: u32, height: u32) -> (Image, Image) {
    let clean: Vec<u8> = (0..height)
        .flat_map(|y| (0..width).flat_map(move |x| (0..3).map(move |c| (x, y, c))))
        .map(|(x, y, c)| ((x * (5 + c) + y * (9 - 3 * c) + 40 * c) % 256) as u8)
        .collect();
    let disturbed = clean
        .iter()
        .enumerate()
        .map(|(index, value)| match index % 3 {
            0 => value ^ (splitmix(7, index as u64) >> 58) as u8,
            _ => *value,
        })
        .collect();
    let image = |samples| Image::new(width, height, 3, samples).expect("an image");
    (image(clean), image(disturbed))
}

fn agrees_with_the_oracle(net: &str, lpips: &Lpips) {
    for expected in expected(net) {
        let (a, b) = images(expected.width, expected.height);
        let layers = lpips.layers(&a, &b).expect("comparable");
        for (index, (found, wanted)) in layers.iter().zip(expected.layers).enumerate() {
            assert!(
                (found - wanted).abs() <= 2e-5 * wanted,
                "{net} {}x{}, layer {index}: {found} instead of {wanted}",
                expected.width,
                expected.height
            );
        }
        let total = lpips.distance(&a, &b).expect("comparable");
        assert!((total - expected.total).abs() <= 2e-5 * expected.total, "{total} {}", expected.total);
        assert_eq!(lpips.distance(&b, &a).expect("comparable"), total, "the distance is symmetric");
        assert_eq!(lpips.distance(&a, &a).expect("comparable"), 0.0);
    }
}

#[test]
fn alex_agrees_with_an_independent_implementation() {
    let lpips = Lpips::from_safetensors(&file(&weights("alex"))).expect("weights");
    assert_eq!(lpips.network(), LpipsNetwork::Alex);
    agrees_with_the_oracle("alex", &lpips);
}

#[test]
fn vgg_agrees_with_an_independent_implementation() {
    let lpips = Lpips::from_safetensors(&file(&weights("vgg"))).expect("weights");
    assert_eq!(lpips.network(), LpipsNetwork::Vgg);
    agrees_with_the_oracle("vgg", &lpips);
}

#[test]
fn torchvision_names_a_scaling_layer_and_tensors_that_nobody_needs_are_understood() {
    let mut tensors = weights("alex");
    as_torchvision_does(&mut tensors);
    tensors.push(Tensor::new("classifier.1.weight", &[1], [f32::NAN]));
    agrees_with_the_oracle("alex", &Lpips::from_safetensors(&file(&tensors)).expect("weights"));

    tensors.push(Tensor::new("scaling_layer.shift", &[1, 3, 1, 1], [-0.030, -0.088, -0.188]));
    tensors.push(Tensor::new("scaling_layer.scale", &[1, 3, 1, 1], [0.458, 0.448, 0.450]));
    agrees_with_the_oracle("alex", &Lpips::from_safetensors(&file(&tensors)).expect("weights"));

    named(&mut tensors, "scaling_layer.scale").bytes = 2.0_f32.to_le_bytes().repeat(3);
    let rescaled = Lpips::from_safetensors(&file(&tensors)).expect("weights");
    let (a, b) = images(64, 48);
    let expected = expected("alex")[0].total;
    assert!((rescaled.distance(&a, &b).expect("comparable") - expected).abs() > 1e-3 * expected);
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let lpips = Lpips::from_safetensors(&file(&weights("alex"))).expect("weights");
    let (a, b) = images(131, 263);
    let layers = [1, 2, 3, 5].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| lpips.layers(&a, &b)).expect("comparable").map(f64::to_bits)
    });
    assert!(layers.iter().all(|bits| *bits == layers[0]), "{layers:?}");
}

#[test]
fn images_that_cannot_be_compared_are_refused() {
    let lpips = Lpips::from_safetensors(&file(&weights("alex"))).expect("weights");
    let distance = |a: &Image, b: &Image| lpips.distance(a, b);
    let (small, _) = images(30, 64);
    let error = distance(&small, &small).expect_err("too small");
    assert!(
        matches!(error, LpipsError::TooSmall { network: LpipsNetwork::Alex, width: 30, height: 64, min: 31 }),
        "{error}"
    );
    let problem = Problem::from(error);
    assert_eq!((problem.status, problem.kind.as_str()), (422, "urn:tcgs:problem:lpips-images"));
    assert!(problem.detail.contains("30x64") && problem.detail.contains("31"), "{}", problem.detail);
    let (least, other) = images(31, 31);
    assert!(distance(&least, &other).expect("large enough") > 0.0);

    let (a, _) = images(40, 40);
    let (b, _) = images(40, 41);
    let alpha = Image::new(40, 40, 4, vec![0; 40 * 40 * 4]).expect("an image");
    assert!(matches!(distance(&a, &b), Err(LpipsError::NotComparable)));
    assert!(matches!(distance(&a, &alpha), Err(LpipsError::NotComparable)));
}

#[test]
fn vgg_needs_sixteen_pixels_a_side() {
    let lpips = Lpips::from_safetensors(&file(&weights("vgg"))).expect("weights");
    lpips.check_size(16, 16).expect("large enough");
    assert!(matches!(lpips.check_size(640, 15), Err(LpipsError::TooSmall { min: 16, height: 15, .. })));
}

/// The fault of AlexNet's weights after a change to them.
fn error(change: impl FnOnce(&mut Vec<Tensor>)) -> LpipsError {
    let mut tensors = weights("alex");
    change(&mut tensors);
    Lpips::from_safetensors(&file(&tensors)).expect_err("the weights are spoilt")
}

#[test]
fn weights_that_cannot_be_used_are_refused_by_the_tensors_name() {
    assert!(matches!(Lpips::from_safetensors(b"PK"), Err(LpipsError::NotSafetensors(_))));
    let whole = file(&weights("alex"));
    for length in [0, 8, 100, whole.len() - 1] {
        assert!(matches!(Lpips::from_safetensors(&whole[..length]), Err(LpipsError::NotSafetensors(_))));
    }

    let missing = error(|tensors| tensors.retain(|tensor| tensor.name != "lin3.model.1.weight"));
    assert!(matches!(missing, LpipsError::Missing { .. }), "{missing}");
    assert!(missing.to_string().contains("lin3.model.1.weight"), "{missing}");
    let empty = error(Vec::clear);
    assert!(empty.to_string().contains("features.0.weight or net.slice1.0.weight"), "{empty}");

    let shape = error(|tensors| {
        let spoilt = named(tensors, "net.slice3.6.weight");
        *spoilt = Tensor::new(&spoilt.name.clone(), &[384, 192, 1, 1], vec![0.0; 384 * 192]);
    });
    let text = shape.to_string();
    for part in ["net.slice3.6.weight", "[384, 192, 1, 1]", "[384, 192, 3, 3]", "lpips-alex"] {
        assert!(text.contains(part), "{text}");
    }

    let other = error(|tensors| {
        let spoilt = named(tensors, "net.slice1.0.weight");
        *spoilt = Tensor::new(&spoilt.name.clone(), &[96, 3, 7, 7], vec![0.0; 96 * 3 * 49]);
    });
    assert!(matches!(other, LpipsError::UnknownNetwork { .. }), "{other}");

    let half = error(|tensors| {
        let spoilt = named(tensors, "net.slice2.3.bias");
        (spoilt.dtype, spoilt.bytes) = (Dtype::F16, vec![0; 192 * 2]);
    });
    assert!(matches!(&half, LpipsError::Type { found: Dtype::F16, .. }), "{half}");
    assert!(half.to_string().contains("net.slice2.3.bias"), "{half}");

    for (name, value) in [("lin0.model.1.weight", f32::NAN), ("net.slice4.8.weight", f32::INFINITY)] {
        let error = error(|tensors| named(tensors, name).bytes[..4].copy_from_slice(&value.to_le_bytes()));
        assert!(matches!(&error, LpipsError::Value { tensor } if tensor == name), "{error}");
    }
    let zero =
        error(|tensors| tensors.push(Tensor::new("scaling_layer.scale", &[1, 3, 1, 1], [1.0, 0.0, 1.0])));
    assert!(matches!(&zero, LpipsError::Value { tensor } if tensor == "scaling_layer.scale"), "{zero}");
    assert_eq!(Problem::from(zero).kind, "urn:tcgs:problem:lpips-weights");
}

#[test]
fn weights_that_lead_beyond_f32_give_no_figure() {
    let mut tensors = weights("alex");
    for name in ["net.slice1.0.weight", "net.slice2.3.weight"] {
        for value in named(&mut tensors, name).bytes.chunks_exact_mut(4) {
            let huge = f32::from_le_bytes([value[0], value[1], value[2], value[3]]) * 1e37;
            value.copy_from_slice(&huge.to_le_bytes());
        }
    }
    let lpips = Lpips::from_safetensors(&file(&tensors)).expect("finite weights");
    let (a, b) = images(64, 48);
    assert!(matches!(lpips.distance(&a, &b), Err(LpipsError::Overflow)));
}
