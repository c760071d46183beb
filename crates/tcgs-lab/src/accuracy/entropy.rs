//! Cases of the entropy model: bits of a symbol under a normal distribution, and their derivatives.

use std::sync::Arc;

use super::{
    case::{Bound, Case, Errors},
    error::CaseError,
    norms::largest,
};
use tcgs_engine::train::twin::symbol_bits;
use tcgs_render::gpu::{Device, KernelSource};

const BITS: &str = "bits, relative to the larger of them and 1";
const BY_VALUE: &str = "derivative by the value, relative";
const BY_DEVIATION: &str = "derivative by the log deviation, relative to its larger term";
const BY_WIDTH: &str = "derivative by the log width, relative";

/// Derivatives below it, a standard deviation or an octave, are as good as none.
const NOTHING: f64 = 1e-6;

const fn bounds(bits: f64, derivatives: f64, why: &'static str) -> [Bound; 4] {
    [
        Bound { quantity: BITS, largest: bits, why },
        Bound { quantity: BY_VALUE, largest: derivatives, why },
        Bound { quantity: BY_DEVIATION, largest: derivatives, why },
        Bound { quantity: BY_WIDTH, largest: derivatives, why },
    ]
}

/// The cases.
pub(super) const CASES: &[Case] = &[
    Case {
        name: "entropy-tiny-scales",
        bounds: &bounds(
            1e-5,
            2e-4,
            "the fits are good to 5e-8, and one minus a density of a bin's edge cancels",
        ),
        measure: tiny_scales,
    },
    Case {
        name: "entropy-huge-scales",
        bounds: &bounds(1e-5, 2e-4, "the derivative is a difference of two densities that are nearly equal"),
        measure: huge_scales,
    },
    Case {
        name: "entropy-10-sigma",
        bounds: &bounds(1e-5, 2e-4, "each case has a form without cancellation"),
        measure: ten_sigma,
    },
    Case {
        name: "entropy-1000-sigma",
        bounds: &bounds(1e-5, 2e-4, "bits are the square of the distance, which f32 has to 1e-7"),
        measure: thousand_sigma,
    },
];

/// Value, mean, deviation, width.
type Row = [f32; 4];

fn compare(device: &Arc<Device>, rows: &[Row]) -> Result<Errors, CaseError> {
    let source = KernelSource { name: "symbol_bits_probe", text: include_str!("symbol_bits_probe.wgsl") };
    let kernel = device.kernel(source, &[])?;
    let given = device.upload("rows", rows)?;
    let found = device.buffer::<[f32; 4]>("bits and derivatives", rows.len())?;
    let mut recorder = device.recorder("bits");
    recorder.dispatch(&kernel, &[&given, &found], rows.len().div_ceil(64) as u32);
    recorder.submit()?;
    let found = device.read(&found)?;
    let errors: Vec<[f64; 4]> = rows.iter().zip(&found).map(|(row, found)| errors_of(row, found)).collect();
    let worst = |column: usize| largest(errors.iter().map(|errors| errors[column]));
    Ok(vec![(BITS, worst(0)), (BY_VALUE, worst(1)), (BY_DEVIATION, worst(2)), (BY_WIDTH, worst(3))])
}

fn errors_of(row: &Row, found: &[f32; 4]) -> [f64; 4] {
    let [value, mean, deviation, width] = row.map(f64::from);
    let found = found.map(f64::from);
    let truth = symbol_bits(value, mean, deviation, width);
    let relative = |found: f64, truth: f64, size: f64| (found - truth).abs() / size.abs().max(NOTHING);
    let by_value = truth.by_value * deviation;
    let larger_term = truth.by_log_deviation.abs().max(truth.by_log_width.abs());
    [
        (found[0] - truth.bits).abs() / truth.bits.max(1.0),
        relative(found[1] * deviation, by_value, by_value),
        relative(found[2], truth.by_log_deviation, larger_term),
        relative(found[3], truth.by_log_width, truth.by_log_width),
    ]
}

/// Values at these distances from the mean, on both sides, for each deviation; bins of width 1.
fn rows(deviations: &[f32], distances: impl Fn(f32) -> Vec<f32>) -> Vec<Row> {
    let mut rows = Vec::new();
    for deviation in deviations {
        for distance in distances(*deviation) {
            rows.extend([[distance, 0.0, *deviation, 1.0], [0.25 - distance, 0.25, *deviation, 1.0]]);
        }
    }
    rows
}

/// Far narrower than a bin: from 1e-3 bins to the finest that is coded.
fn tiny_scales(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let distances = |_| vec![0.0, 0.1, 0.4, 0.499, 0.501, 0.6, 1.0, 3.0];
    compare(device, &rows(&[1e-3, 0.01, 0.088_388, 0.2], distances))
}

/// Far wider than a bin: to a thousand times the coarsest that is coded.
fn huge_scales(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let distances = |deviation| [0.0, 0.01, 0.3, 1.0, 3.0].map(|z| z * deviation).to_vec();
    compare(device, &rows(&[64.0, 1243.0, 1e5, 1e6], distances))
}

fn sigmas(device: &Arc<Device>, far: [f32; 4]) -> Result<Errors, CaseError> {
    let distances = |deviation| far.map(|z| z * deviation).to_vec();
    compare(device, &rows(&[0.088_388, 0.5, 1.0, 7.0, 300.0], distances))
}

fn ten_sigma(device: &Arc<Device>) -> Result<Errors, CaseError> {
    sigmas(device, [8.0, 9.5, 10.0, 12.0])
}

fn thousand_sigma(device: &Arc<Device>) -> Result<Errors, CaseError> {
    sigmas(device, [30.0, 100.0, 300.0, 1000.0])
}
