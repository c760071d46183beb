//! Bits of a symbol: the twin against independent values and central differences, the device against both.

use std::f64::consts::LN_2;

use safetensors::{Dtype, SafeTensors};
use tcgs::{
    gpu::KernelSource,
    train::twin::{SymbolBits, symbol_bits},
};

use crate::support::{gpu::gpu, oracle::committed};

/// Value, mean, standard deviation, width of the bin.
type Row = [f32; 4];

struct Oracle {
    rows: Vec<Row>,
    expected: Vec<SymbolBits>,
}

impl Oracle {
    fn load() -> Self {
        let bytes = committed("entropy.safetensors.gz");
        let tensors = SafeTensors::deserialize(&bytes).expect("safetensors");
        let numbers = |name: &str| -> Vec<f64> {
            let tensor = tensors.tensor(name).expect(name);
            let data = tensor.data();
            match tensor.dtype() {
                Dtype::F32 => {
                    data.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect()
                }
                Dtype::F64 => data.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
                other => panic!("{name} is {other:?}"),
            }
        };
        let columns = ["x", "mu", "sigma", "q"].map(numbers);
        let rows = (0..columns[0].len()).map(|i| [0, 1, 2, 3].map(|c: usize| columns[c][i] as f32)).collect();
        let [bits, d_x, d_sigma, d_q] = ["bits", "d_x", "d_sigma", "d_q"].map(numbers);
        let expected = (0..bits.len())
            .map(|i| SymbolBits {
                bits: bits[i],
                by_value: d_x[i],
                by_log_deviation: d_sigma[i] * columns[2][i] * LN_2,
                by_log_width: d_q[i] * columns[3][i] * LN_2,
            })
            .collect();
        Self { rows, expected }
    }
}

fn on_twin([value, mean, deviation, width]: Row) -> SymbolBits {
    symbol_bits(value.into(), mean.into(), deviation.into(), width.into())
}

fn on_device(rows: &[Row]) -> Vec<[f32; 4]> {
    let device = gpu();
    let source = KernelSource {
        name: "symbol_bits_probe",
        text: include_str!("../../../../crates/tcgs-lab/src/accuracy/symbol_bits_probe.wgsl"),
    };
    let kernel = device.kernel(source, &[]).expect("the probe");
    let given = device.upload("rows", rows).expect("room");
    let found = device.buffer::<[f32; 4]>("found", rows.len()).expect("room");
    let mut recorder = device.recorder("probe");
    recorder.dispatch(&kernel, &[&given, &found], rows.len().div_ceil(64) as u32);
    recorder.submit().expect("submitted");
    device.read(&found).expect("read")
}

/// The oracle's bits agree with arithmetic of 60 digits; its derivatives, taken in f64, are up to 3e-7 off in the deep tail,
/// where the next test has one of its rows in 60 digits.
#[test]
fn the_twin_agrees_with_the_independent_values() {
    let oracle = Oracle::load();
    for (row, expected) in oracle.rows.iter().zip(&oracle.expected) {
        let found = on_twin(*row);
        let near = |found: f64, expected: f64, bound: f64| {
            let error = (found - expected).abs() / expected.abs().max(1.0);
            assert!(error <= bound, "{row:?}: {found:?} {expected:?}: {error:e}");
        };
        near(found.bits, expected.bits, 1e-9);
        let bound = if expected.bits < 100.0 { 1e-9 } else { 5e-7 };
        near(found.by_value, expected.by_value, bound);
        near(found.by_log_deviation, expected.by_log_deviation, bound);
        near(found.by_log_width, expected.by_log_width, bound);
    }
}

#[test]
fn the_twins_derivatives_are_right_in_the_deep_tail() {
    let found = on_twin([5.0, 0.0, 0.001, 1.0]);
    assert!((found.by_value / 6_492_127.387_880_209 - 1.0).abs() < 1e-12, "{found:?}");
    assert!((found.by_log_deviation / -20_249_999.076_353_26 - 1.0).abs() < 1e-12, "{found:?}");
}

/// Rows on both sides of every change of form.
fn rows_of_all_forms() -> Vec<[f64; 4]> {
    let mut rows = Vec::new();
    for deviation in [0.01, 0.088, 0.4, 1.0, 3.0, 40.0, 1250.0] {
        for distance in [0.0, 1e-3, 0.2, 0.49, 0.51, 0.8, 2.0, 7.3, 60.0] {
            for width in [0.09, 1.0, 11.0] {
                rows.push([distance, 0.0, deviation, width]);
                rows.push([-distance, 0.25, deviation, width]);
            }
        }
    }
    rows
}

#[test]
fn the_twins_derivatives_are_those_of_its_bits() {
    for row in rows_of_all_forms() {
        let [value, mean, deviation, width] = row;
        let found = symbol_bits(value, mean, deviation, width);
        let checks = [
            // Of the natural size of each argument, and small against the deviation.
            (found.by_value, 1e-5 * deviation, [1.0, 0.0, 0.0]),
            (found.by_log_deviation, 1e-5, [0.0, 1.0, 0.0]),
            (found.by_log_width, 1e-5, [0.0, 0.0, 1.0]),
        ];
        for (found, reach, [dv, ds, dw]) in checks {
            let at = |by: f64| {
                let (by_deviation, by_width) = ((by * ds).exp2(), (by * dw).exp2());
                symbol_bits(value + by * dv, mean, deviation * by_deviation, width * by_width).bits
            };
            let expected = (at(reach) - at(-reach)) / (2.0 * reach);
            let size = expected.abs().max(1e-3 / reach * 1e-5).max(1e-3);
            assert!((found - expected).abs() < 2e-5 * size, "{row:?}: {found} {expected}");
        }
    }
}

#[test]
fn the_forms_agree_where_they_change() {
    for deviation in [0.1_f64, 0.5, 1.0, 4.0, 100.0] {
        // a = 0, and y = 1/2.
        for at in [0.5, deviation * deviation] {
            let [before, after] = [at * (1.0 - 1e-12), at * (1.0 + 1e-12)];
            let [before, after] = [before, after].map(|value| symbol_bits(value, 0.0, deviation, 1.0));
            let near = |a: f64, b: f64| (a - b).abs() < 1e-10 * (1.0 + b.abs());
            assert!(near(before.bits, after.bits), "{deviation}: {before:?} {after:?}");
            assert!(near(before.by_value, after.by_value), "{deviation}: {before:?} {after:?}");
        }
    }
}

/// Largest errors among the rows of up to some bits: of the bits, and of their derivatives.
struct Class {
    /// Rows of fewer bits than this, and of at least those of the class before.
    below: f64,
    /// Bound on the bits' error; beyond 100 bits, relative.
    bits: f64,
    /// Bound on the derivatives' relative error: by value, log deviation, log width.
    derivatives: [f64; 3],
}

/// The table of `src/train/context/rate.rs`, with room for adapters whose exp and log2 are a few units less exact.
const CLASSES: [Class; 4] = [
    Class { below: 8.0, bits: 1e-5, derivatives: [2e-4, 2e-4, 2e-4] },
    Class { below: 30.0, bits: 4e-5, derivatives: [1e-4, 1e-5, 1e-5] },
    Class { below: 100.0, bits: 3e-4, derivatives: [1e-5, 1e-5, 1e-5] },
    Class { below: f64::INFINITY, bits: 1e-5, derivatives: [1e-5, 1e-5, 1e-5] },
];

/// Derivatives below it, a standard deviation or an octave, are as good as none.
const NOTHING: f64 = 1e-6;

#[test]
fn the_device_is_right_on_every_row_of_the_oracle() {
    let oracle = Oracle::load();
    let found = on_device(&oracle.rows);
    let mut worst = [[0.0_f64; 4]; CLASSES.len()];
    for ((row, found), expected) in oracle.rows.iter().zip(&found).zip(&oracle.expected) {
        let found = found.map(f64::from);
        assert!(found.iter().all(|v| v.is_finite()) && found[0] >= 0.0, "{row:?}: {found:?}");
        let class = CLASSES.iter().position(|class| expected.bits < class.below).expect("a class");
        let deviation = f64::from(row[2]);
        let error = (found[0] - expected.bits).abs();
        let relative =
            |found: f64, expected: f64, size: f64| (found - expected).abs() / size.abs().max(NOTHING);
        let errors = [
            if class == 3 { error / expected.bits } else { error },
            relative(found[1] * deviation, expected.by_value * deviation, expected.by_value * deviation),
            // The difference of two terms, of which that of the width is one.
            relative(
                found[2],
                expected.by_log_deviation,
                expected.by_log_deviation.abs().max(expected.by_log_width.abs()),
            ),
            relative(found[3], expected.by_log_width, expected.by_log_width),
        ];
        for (worst, error) in worst[class].iter_mut().zip(errors) {
            *worst = worst.max(error);
        }
    }
    println!("largest errors of bits, by value, log deviation, log width: {worst:?}");
    for (class, worst) in CLASSES.iter().zip(worst) {
        let bounds = [&[class.bits][..], &class.derivatives[..]].concat();
        let holds = worst.iter().zip(&bounds).all(|(worst, bound)| worst <= bound);
        assert!(holds, "below {} bits: {worst:?} beyond {bounds:?}", class.below);
    }
}
