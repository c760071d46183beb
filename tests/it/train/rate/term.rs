//! The rate term: the twin against central differences, the kernel against the twin.

use tcgs::{
    domain::AttributeGroup,
    model::ModelShape,
    train::{
        context::QuantizationPhase,
        twin::{
            RateGradients, RateInput, quantize_gradient, rate, refresh_quant_steps, sum_bits, symbol_bits,
        },
    },
};

use super::scene::{
    BASE_STEPS, Case, JUNK, LAMBDA, OnDevice, SMALL, USUAL, columns, f64s, quantization, random_gradients,
    rounded_octaves,
};
use crate::support::{gpu::gpu, oracle::relative_l2};

const PHASES: [QuantizationPhase; 2] = [QuantizationPhase::Noise, QuantizationPhase::Rounded];

/// A value of 400 steps is known to 3e-5 of a step in f32, which is 3e-4 of the finest standard deviation; most are finer.
const BOUND: f64 = 1e-4;

/// The twin on a group of one anchor.
fn on_twin(phase: QuantizationPhase, shape: ModelShape, input: RateInput<'_>) -> RateGradients {
    let columns = columns(shape);
    let (first, end) = (columns[input.group as usize], columns[input.group as usize + 1]);
    rate(&quantization(phase), &RateInput { first, row: &input.row[first..end], ..input })
}

/// One channel of the first group of anchor 0.
fn channel<'a>(row: &'a [f64], outputs: &'a [f64], d_log_step: f64) -> RateInput<'a> {
    let group = AttributeGroup::Features;
    RateInput { anchor: 0, group, first: 0, row, mask: 0, outputs, d_log_step, weight: 1.0 }
}

#[test]
fn the_twins_gradient_is_that_of_its_bits() {
    const COUNT: usize = 12;
    let case = Case::random(21, SMALL, COUNT, COUNT);
    let mut compared = 0;
    for (place, anchor) in case.sample.iter().map(|anchor| *anchor as usize).enumerate() {
        let row = f64s(case.anchors.row(anchor));
        let mask = case.anchors.masks[anchor];
        for group in AttributeGroup::ALL {
            let first = columns(SMALL)[group as usize];
            let outputs = f64s(&case.outputs[group as usize][place]);
            let of = |row: &[f64], outputs: &[f64]| {
                let input = RateInput { anchor: anchor as u32, group, mask, ..channel(row, outputs, 0.0) };
                on_twin(QuantizationPhase::Noise, SMALL, input)
            };
            let total = |row: &[f64], outputs: &[f64]| -> f64 { of(row, outputs).bits.iter().sum() };
            let found = of(&row, &outputs);
            let channels = found.row.len();
            let octaves = outputs[2 * channels].clamp(-3.5, 3.5);
            let is_bounded = |channel: usize| {
                let coded = outputs[channels + channel] - octaves;
                !(-3.499..10.28).contains(&coded)
            };
            for (place, gradient) in found.outputs.iter().enumerate() {
                // Where a bound holds, what leads back passes: see the test of it.
                if (channels..2 * channels).contains(&place) && is_bounded(place - channels) {
                    continue;
                }
                let at = |by: f64| {
                    let mut moved = outputs.clone();
                    moved[place] += by;
                    total(&row, &moved)
                };
                let expected = (at(1e-6) - at(-1e-6)) / 2e-6;
                let error = (gradient - expected).abs();
                assert!(error < 1e-5 * (1.0 + expected.abs()), "{group:?} {place}: {gradient} {expected}");
                compared += 1;
            }
            let step = f64::from(BASE_STEPS[group as usize]) * octaves.exp2();
            for (channel, gradient) in found.row.iter().enumerate() {
                if group == AttributeGroup::Scalings && row[first + channel].exp() < step {
                    assert!(*gradient <= 0.0, "below one step it can only be asked to grow");
                    continue;
                }
                let reach = if group == AttributeGroup::Scalings { 1e-6 } else { 1e-6 * step };
                let at = |by: f64| {
                    let mut moved = row.clone();
                    moved[first + channel] += by;
                    total(&moved, &outputs)
                };
                let expected = (at(reach) - at(-reach)) / (2.0 * reach);
                let error = (gradient - expected).abs();
                assert!(
                    error < 1e-5 * (1.0 / step + expected.abs()),
                    "{group:?} {channel}: {gradient} {expected}"
                );
                compared += 1;
            }
        }
    }
    assert!(compared > 600, "{compared}");
}

#[test]
fn beyond_the_coded_deviations_only_what_leads_back_passes() {
    // One channel, a step of one; value and mean apart or together, the deviation below, inside and above the bounds.
    let by = tcgs::train::context::Quantization {
        base_quant_steps: [1.0; 3],
        ..quantization(QuantizationPhase::Rounded)
    };
    let by_scale =
        |apart: f64, octaves: f64| rate(&by, &channel(&[apart], &[0.0, octaves, 0.0], 0.0)).outputs[1];
    assert!(by_scale(3.0, -5.0) < -1.0, "a badly predicted value asks for more");
    assert_eq!(by_scale(0.0, -5.0), 0.0, "a well predicted one no longer for less");
    assert!(by_scale(0.0, 12.0) > 0.1, "too wide a distribution is narrowed");
    assert_eq!(by_scale(1e5, 12.0), 0.0);
    assert!(by_scale(0.0, 0.0) > 0.0 && by_scale(3.0, 0.0) < 0.0);
    let by_adjustment =
        |adjustment: f64| rate(&by, &channel(&[3.0], &[0.0, 1.0, adjustment], 0.5)).outputs[2];
    assert!(by_adjustment(3.4) != 0.0 && by_adjustment(3.6) == 0.0 && by_adjustment(-3.6) == 0.0);
}

#[test]
fn what_is_far_out_is_stored_as_an_escape_and_pulled_back_all_the_same() {
    let by = tcgs::train::context::Quantization {
        base_quant_steps: [1.0; 3],
        ..quantization(QuantizationPhase::Rounded)
    };
    let at = |value: f64| rate(&by, &channel(&[value], &[0.0; 3], 0.0));
    let near = at(4.0);
    assert_eq!(near.stored, near.bits, "within the table");
    for value in [8.0, 100.0, -1e4, 1e6] {
        let far = at(value);
        // A file: 24 bits of the escape, a sign, and an Exp-Golomb code of the distance to the table's end, 7 steps out.
        let escape = 24.0 + 2.0 + 2.0 * (value.abs() - 7.0).log2().floor();
        assert!(far.bits[0] > far.stored[0], "{value}: {far:?}");
        assert!((-0.1..7.0).contains(&(far.stored[0] - escape)), "{value}: {} {escape}", far.stored[0]);
        assert!(far.row[0] * value.signum() >= at(4.0).row[0], "{value}: {far:?}");
    }
}

#[test]
fn the_bits_of_the_last_sample_outlast_a_change_of_room() {
    const COUNT: usize = 40;
    let device = gpu();
    let case = Case::random(46, SMALL, COUNT, COUNT);
    let uploaded = OnDevice::upload(&device, &case, &random_gradients(47, COUNT * SMALL.row()));
    uploaded.run(&device, &quantization(QuantizationPhase::Noise));
    let before = uploaded.rate.sums(&device).expect("read");
    assert!(before.iter().all(|bits| *bits > 0.0), "{before:?}");
    let roomier = uploaded.rate.with_capacity(&device, 500).expect("room");
    assert_eq!(roomier.capacity(), 500);
    assert_eq!(roomier.sums(&device).expect("read"), before);
}

#[test]
fn a_stray_anchor_does_not_decide_what_a_scene_is_said_to_take() {
    const COUNT: usize = 40;
    let device = gpu();
    let by = quantization(QuantizationPhase::Rounded);
    let mut case = Case::random(44, SMALL, COUNT, COUNT);
    let sums = |case: &Case| {
        let uploaded = OnDevice::upload(&device, case, &random_gradients(45, COUNT * SMALL.row()));
        uploaded.run(&device, &by);
        uploaded.rate.sums(&device).expect("read")
    };
    let before = sums(&case);
    let stray = case.sample[3] as usize;
    case.anchors.values[stray * SMALL.row()..][..SMALL.features].fill(1e6);
    let after = sums(&case);
    let stored: f64 = case
        .sample
        .iter()
        .zip(&case.outputs[0])
        .map(|(anchor, outputs)| {
            let (row, outputs) = (f64s(case.anchors.row(*anchor as usize)), f64s(outputs));
            let group = AttributeGroup::Features;
            let input = RateInput { anchor: *anchor, group, ..channel(&row, &outputs, 0.0) };
            on_twin(by.phase, SMALL, input).stored.iter().sum::<f64>()
        })
        .sum();
    assert!((after[0] - stored).abs() < 2e-5 * stored, "{} {stored}", after[0]);
    assert!(after[0] - before[0] < 80.0 * SMALL.features as f64, "{before:?} {after:?}");
    assert_eq!(after[1..], before[1..]);
}

#[test]
fn rounded_bits_are_those_of_the_decoders_numbers() {
    const COUNT: usize = 10;
    let case = Case::random(22, SMALL, COUNT, COUNT);
    let spacings = |octaves: f64| (((octaves * 256.0 + 0.5).floor() as i64) * 1170 + (1 << 15)) >> 16;
    for (place, anchor) in case.sample.iter().map(|anchor| *anchor as usize).enumerate() {
        let row = f64s(case.anchors.row(anchor));
        for group in AttributeGroup::ALL {
            let outputs = f64s(&case.outputs[group as usize][place]);
            let found = on_twin(
                QuantizationPhase::Rounded,
                SMALL,
                RateInput { anchor: anchor as u32, group, mask: u32::MAX, ..channel(&row, &outputs, 0.0) },
            );
            let channels = found.bits.len();
            let octaves = rounded_octaves(outputs[2 * channels]);
            let step = f64::from(BASE_STEPS[group as usize]) * octaves.exp2();
            let refreshed =
                refresh_quant_steps(&quantization(QuantizationPhase::Rounded), group, outputs[2 * channels]);
            assert!((refreshed - step).abs() < 1e-12 * step);
            for channel in 0..channels {
                let value = row[columns(SMALL)[group as usize] + channel];
                let value = if group == AttributeGroup::Scalings { value.exp() } else { value };
                let symbol = (value / step).round();
                let symbol = if group == AttributeGroup::Scalings { symbol.max(1.0) } else { symbol };
                let mean16 = (16.0 * outputs[channel] / octaves.exp2() + 0.5).floor();
                let index = (octaves * 32.0 / 7.0).round() as i64;
                let scale = (spacings(outputs[channels + channel]) + 16 - index).clamp(0, 63);
                let deviation = (-3.5 + 7.0 / 32.0 * scale as f64).exp2();
                let expected = symbol_bits(symbol, mean16 / 16.0, deviation, 1.0).bits;
                let error = (found.bits[channel] - expected).abs();
                assert!(error < 1e-9 * (1.0 + expected), "{group:?}: {} {expected}", found.bits[channel]);
            }
        }
    }
}

fn check_against_twin(shape: ModelShape, count: usize, sampled: usize, phase: QuantizationPhase) {
    let device = gpu();
    let case = Case::random((count + sampled) as u64, shape, count, sampled);
    let d_rendered = random_gradients(31, count * shape.row());
    let uploaded = OnDevice::upload(&device, &case, &d_rendered);
    let by = quantization(phase);
    uploaded.run(&device, &by);

    let weight = LAMBDA / (sampled * shape.row()) as f64;
    let scaled_up = count as f64 / sampled as f64;
    let mut d_rows: Vec<f64> = Vec::new();
    let mut d_log_steps = Vec::new();
    for anchor in 0..count {
        let d = f64s(&d_rendered[anchor * shape.row()..][..shape.row()]);
        let row = f64s(case.anchors.row(anchor));
        let (mask, steps) = (case.anchors.masks[anchor], case.own_steps(anchor));
        let (d_row, by_steps) = quantize_gradient(shape, &by, anchor as u32, &row, mask, steps, &d);
        d_rows.extend(d_row);
        d_log_steps.push(by_steps);
    }
    let mut steps = f64s(&case.steps);
    let bits = uploaded.bits(&device);
    let sums = uploaded.rate.sums(&device).expect("read");
    for group in AttributeGroup::ALL {
        let what = format!("{shape:?} {sampled} of {count} {phase:?} {group:?}");
        let found = uploaded.output_gradients(&device, group as usize);
        let (mut all_found, mut all_expected, mut costs) =
            ([const { Vec::new() }; 3], [const { Vec::new() }; 3], Vec::new());
        for (place, anchor) in case.sample.iter().map(|anchor| *anchor as usize).enumerate() {
            let row = f64s(case.anchors.row(anchor));
            let outputs = f64s(&case.outputs[group as usize][place]);
            let mask = case.anchors.masks[anchor];
            let d_log_step = scaled_up * d_log_steps[anchor][group as usize];
            let input = channel(&row, &outputs, d_log_step);
            let input = RateInput { anchor: anchor as u32, group, mask, weight, ..input };
            let expected = on_twin(phase, shape, input);
            let channels = expected.row.len();
            for (part, range) in
                [0..channels, channels..2 * channels, 2 * channels..2 * channels + 1].into_iter().enumerate()
            {
                all_found[part].extend_from_slice(&found[place][range.clone()]);
                all_expected[part].extend_from_slice(&expected.outputs[range]);
            }
            for (channel, d) in expected.row.iter().enumerate() {
                d_rows[anchor * shape.row() + columns(shape)[group as usize] + channel] += d;
            }
            steps[3 * anchor + group as usize] = refresh_quant_steps(&by, group, outputs[2 * channels]);
            let cost: f64 = expected.stored.iter().sum();
            let error = (bits[group as usize][place] - cost).abs();
            assert!(error < 2e-5 * (1.0 + cost), "{what}: {} {cost}", bits[group as usize][place]);
            costs.push(cost);
            if group == AttributeGroup::Offsets {
                for (k, expected) in expected.bits.chunks(3).enumerate() {
                    let (found, expected) = (bits[3 + k][place], expected.iter().sum::<f64>());
                    assert!((found - expected).abs() < 2e-5 * (1.0 + expected), "{what}: {found} {expected}");
                    assert!(mask >> k & 1 == 1 || found == 0.0, "{what}: a masked offset costs {found}");
                }
            }
        }
        for (part, name) in ["means", "log deviations", "adjustments"].into_iter().enumerate() {
            let error = relative_l2(&all_found[part], &all_expected[part]);
            assert!(error < BOUND, "{what} {name}: {error:e}");
        }
        let expected = sum_bits(&costs);
        let found = sums[group as usize];
        assert!((found - expected).abs() < 2e-5 * (1.0 + expected), "{what}: {found} {expected}");
    }
    let found = device.read(&uploaded.d_rows).expect("read");
    let error = relative_l2(&f64s(&found), &d_rows);
    assert!(error < BOUND, "{shape:?} {phase:?}: gradients of rows: {error:e}");
    let found = device.read(uploaded.quantized.steps()).expect("read");
    for (i, (found, expected)) in found.iter().zip(&steps).enumerate() {
        if case.sample.contains(&(i as u32 / 3)) {
            assert!((f64::from(*found) - expected).abs() < 1e-6 * expected, "{found} {expected}");
        } else {
            assert_eq!(
                found.to_bits(),
                case.steps[i].to_bits(),
                "an anchor outside the sample keeps its step"
            );
        }
    }
}

#[test]
fn the_kernel_matches_the_twin() {
    for phase in PHASES {
        for (count, sampled) in [(1, 1), (70, 65), (300, 40)] {
            check_against_twin(SMALL, count, sampled, phase);
        }
        check_against_twin(USUAL, 80, 33, phase);
        check_against_twin(ModelShape::new(50, 10), 20, 20, phase);
    }
}

#[test]
fn a_step_that_will_be_done_again_leaves_the_steps_and_the_same_input_gives_the_same_bits() {
    let device = gpu();
    let case = Case::random(41, SMALL, 90, 30);
    let d_rendered = random_gradients(42, 90 * SMALL.row());
    let by = quantization(QuantizationPhase::Noise);
    let run = |mark: u32| {
        let uploaded = OnDevice::upload(&device, &case, &d_rendered);
        device.write(&uploaded.overflow_flag, &[mark]);
        uploaded.run(&device, &by);
        let outputs = [0, 1, 2].map(|group| uploaded.output_gradients(&device, group));
        let rows: Vec<u32> =
            device.read(&uploaded.d_rows).expect("read").iter().map(|v| v.to_bits()).collect();
        (device.read(uploaded.quantized.steps()).expect("read"), outputs, rows, uploaded.bits(&device))
    };
    let (void, first, second) = (run(77), run(0), run(0));
    assert!(void.0 == case.steps && first.0 != case.steps);
    assert!(first == second);
    assert!((&void.1, &void.2, &void.3) == (&first.1, &first.2, &first.3));
}

#[test]
fn what_is_not_sampled_is_left_alone() {
    let device = gpu();
    let case = Case::random(43, SMALL, 20, 0);
    let d_rendered = random_gradients(44, 20 * SMALL.row());
    let uploaded = OnDevice::upload(&device, &case, &d_rendered);
    uploaded.run(&device, &quantization(QuantizationPhase::Noise));
    assert_eq!(uploaded.rate.sums(&device).expect("read"), [0.0; 3]);
    assert!(device.read(&uploaded.d_outputs).expect("read").iter().all(|v| *v == JUNK));
    assert_eq!(device.read(uploaded.quantized.steps()).expect("read"), case.steps);
}
