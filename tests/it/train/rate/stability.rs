//! Hard cases of the rate term: what is far off, at a bound, masked, alone or no number.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{domain::AttributeGroup, train::context::QuantizationPhase};

use super::scene::{Case, OnDevice, SMALL, columns, quantization};
use crate::support::gpu::gpu;

const PHASES: [QuantizationPhase; 2] = [QuantizationPhase::Noise, QuantizationPhase::Rounded];

/// Everything that the device wrote: by group the gradients of outputs, rows' gradients, bits, steps.
struct Found {
    outputs: [Vec<Vec<f64>>; 3],
    rows: Vec<f32>,
    bits: Vec<Vec<f64>>,
    steps: Vec<f32>,
}

fn found(case: &Case, phase: QuantizationPhase) -> Found {
    let device = gpu();
    let uploaded = OnDevice::upload(&device, case, &vec![0.0; case.anchors.values.len()]);
    uploaded.run(&device, &quantization(phase));
    Found {
        outputs: [0, 1, 2].map(|group| uploaded.output_gradients(&device, group)),
        rows: device.read(&uploaded.d_rows).expect("read"),
        bits: uploaded.bits(&device),
        steps: device.read(uploaded.quantized.steps()).expect("read"),
    }
}

fn assert_sound(found: &Found, what: &str) {
    assert!(found.outputs.iter().flatten().flatten().all(|v| v.abs() < 1e9), "{what}: outputs");
    assert!(found.rows.iter().all(|v| v.is_finite()), "{what}: rows");
    assert!(found.bits.iter().flatten().all(|v| v.is_finite() && *v >= 0.0), "{what}: bits");
    assert!(found.steps.iter().all(|v| v.is_finite() && *v > 0.0), "{what}: steps");
}

#[test]
fn a_value_a_million_steps_away_is_pulled_back_and_drowns_nobody() {
    for phase in PHASES {
        for column in [0, SMALL.scaling_column(), SMALL.offset_column()] {
            let mut case = Case::random(61, SMALL, 20, 20);
            let (place, anchor) = (3, case.sample[3] as usize);
            let group = columns(SMALL)[1..].iter().filter(|end| column >= **end).count();
            case.anchors.masks[anchor] = u32::MAX;
            let before = found(&case, phase);
            // The finest deviation, and the value far above the mean.
            let channels = columns(SMALL)[group + 1] - columns(SMALL)[group];
            case.outputs[group][place][channels] = -40.0;
            case.outputs[group][place][2 * channels] = 0.0;
            case.anchors.values[anchor * SMALL.row() + column] = if group == 1 { 10.0 } else { 1e6 };
            let after = found(&case, phase);
            let what = format!("{phase:?} {column}");
            assert_sound(&after, &what);
            let more = after.bits[group][place] - before.bits[group][place];
            assert!((20.0..90.0).contains(&more), "{what}: a file takes an escape for it, not {more} bits");
            assert!(group != 2 || after.bits[3][place] > 1e6, "{what}: {}", after.bits[3][place]);
            assert!(after.rows[anchor * SMALL.row() + column] > 0.0, "{what}: the value is pulled down");
            assert!(after.outputs[group][place][0] < 0.0, "{what}: the mean is pulled up");
            assert!(after.outputs[group][place][channels] < 0.0, "{what}: the deviation is widened");
            let weight = 3.0 / (20 * SMALL.row()) as f64;
            let largest = after.outputs[group][place][channels].abs();
            assert!(largest <= 1.001e4 * weight, "{what}: {largest}");
            for (other, outputs) in after.outputs[group].iter().enumerate() {
                assert!(other == place || *outputs == before.outputs[group][other], "{what}: {other}");
            }
        }
    }
}

#[test]
fn numbers_that_are_none_cost_nothing_and_disturb_nobody() {
    for phase in PHASES {
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 3e38] {
            for group in AttributeGroup::ALL {
                let place = group as usize;
                let channels = columns(SMALL)[place + 1] - columns(SMALL)[place];
                // A value of the row, then a mean, a deviation and the adjustment.
                for spoilt in 0..4 {
                    let mut case = Case::random(62, SMALL, 12, 12);
                    let before = found(&case, phase);
                    let anchor = case.sample[5] as usize;
                    match spoilt {
                        0 => case.anchors.values[anchor * SMALL.row() + columns(SMALL)[place]] = value,
                        1 => case.outputs[place][5][0] = value,
                        2 => case.outputs[place][5][channels] = value,
                        _ => case.outputs[place][5][2 * channels] = value,
                    }
                    let after = found(&case, phase);
                    let what = format!("{phase:?} {value} {group:?} {spoilt}");
                    assert_sound(&after, &what);
                    for other in (0..12).filter(|other| *other != 5) {
                        assert!(after.outputs[place][other] == before.outputs[place][other], "{what}");
                    }
                    if spoilt == 3 {
                        assert_eq!(after.bits[place][5], 0.0, "{what}");
                        assert_eq!(after.steps[3 * anchor + place], case.steps[3 * anchor + place], "{what}");
                    }
                }
            }
        }
    }
}

#[test]
fn an_anchor_whose_offsets_are_all_masked_pays_for_none_of_them() {
    for phase in PHASES {
        let mut case = Case::random(63, SMALL, 1, 1);
        case.anchors.masks[0] = 0;
        let found = found(&case, phase);
        assert_sound(&found, "masked");
        assert!(found.bits[2..].iter().flatten().all(|bits| *bits == 0.0));
        assert!(found.bits[0][0] > 0.0 && found.bits[1][0] > 0.0);
        assert!(found.outputs[2][0].iter().all(|v| *v == 0.0));
        assert!(found.rows[SMALL.offset_column()..].iter().all(|v| *v == 0.0));
    }
}

#[test]
fn whatever_networks_and_rows_hold_gradients_are_finite_and_bits_are_not_negative() {
    let mut rng = Pcg64::seed_from_u64(64);
    let mut wild =
        |reach: f32| rng.random_range(-1.0..1.0_f32) * 10_f32.powf(rng.random_range(-reach..reach));
    for round in 0..6 {
        let mut case = Case::random(65 + round, SMALL, 40, 40);
        case.anchors.values.iter_mut().for_each(|value| *value = wild(8.0));
        case.outputs.iter_mut().flatten().flatten().for_each(|value| *value = wild(6.0));
        for phase in PHASES {
            assert_sound(&found(&case, phase), &format!("round {round} {phase:?}"));
        }
    }
}
