//! Rendered rows and their way back: the twins against central differences, the kernels against the twins.

use tcgs::train::{
    context::{Quantization, QuantizationPhase, QuantizedRows},
    twin::{noise, quantize_gradient, quantize_rows},
};

use super::scene::{
    BASE_STEPS, Case, JUNK, OnDevice, SMALL, USUAL, columns, f64s, quantization, random_gradients,
};
use crate::support::{gpu::gpu, oracle::relative_l2};

const PHASES: [QuantizationPhase; 3] =
    [QuantizationPhase::FixedNoise, QuantizationPhase::Noise, QuantizationPhase::Rounded];

#[test]
fn noise_is_uniform_and_unlike_its_neighbors() {
    let mut values = Vec::new();
    for key in [Quantization::key(0, 1), Quantization::key(0, 2), Quantization::key(1, 1)] {
        values.push((0..400).flat_map(|a| (0..50).map(move |c| noise(key, a, c))).collect::<Vec<_>>());
    }
    for noise in &values {
        let count = noise.len() as f64;
        assert!(noise.iter().all(|v| v.abs() < 0.5));
        let mean = noise.iter().sum::<f64>() / count;
        let variance = noise.iter().map(|v| v * v).sum::<f64>() / count;
        // Four standard errors of 20 000 draws.
        assert!(mean.abs() < 4.0 * (1.0 / 12.0 / count).sqrt(), "{mean}");
        assert!((variance - 1.0 / 12.0).abs() < 4.0 * (1.0 / 180.0 / count).sqrt(), "{variance}");
        for apart in [1, 2, 3, 50, 51, 100] {
            let product = noise.iter().zip(&noise[apart..]).map(|(a, b)| a * b).sum::<f64>();
            assert!((product / count).abs() < 4.0 / 12.0 / count.sqrt(), "{apart} apart: {product}");
        }
    }
    let together = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>() / a.len() as f64;
    for [a, b] in [[0, 1], [0, 2], [1, 2]] {
        assert!(together(&values[a], &values[b]).abs() < 4.0 / 12.0 / 20_000_f64.sqrt());
    }
}

#[test]
fn the_twins_gradient_is_that_of_its_rows_with_noise_and_residuals_held() {
    let case = Case::random(3, SMALL, 6, 0);
    let ends = columns(SMALL);
    for phase in PHASES {
        let by = quantization(phase);
        for anchor in 0..6 {
            let row = f64s(case.anchors.row(anchor));
            let (mask, steps) = (case.anchors.masks[anchor], case.own_steps(anchor));
            let widths =
                if phase == QuantizationPhase::FixedNoise { BASE_STEPS.map(f64::from) } else { steps };
            // Positive, so that no scaling below its step asks for more.
            let d: Vec<f64> = random_gradients(9, SMALL.row()).iter().map(|v| f64::from(v.abs())).collect();
            // Everything rendered by value and step, the residual that of the row as it is.
            let loss = |moved: &[f64], widths: [f64; 3]| -> f64 {
                let parts = (0..SMALL.row()).map(|column| {
                    let group = ends[1..].iter().filter(|end| column >= **end).count();
                    let still = &row[column];
                    let residual = |value: f64, width: f64| match phase {
                        QuantizationPhase::Rounded => (value / width).round() - value / width,
                        _ => noise(by.key, anchor as u32, column as u32),
                    };
                    let old = if phase == QuantizationPhase::FixedNoise {
                        f64::from(BASE_STEPS[group])
                    } else {
                        steps[group]
                    };
                    let rendered = match group {
                        1 => {
                            let held = residual(still.exp().max(old), old);
                            (moved[column].exp().max(widths[1]) + held * widths[1]).ln()
                        }
                        2 if mask >> ((column - ends[2]) / 3) & 1 == 0 => moved[column],
                        _ => moved[column] + residual(*still, old) * widths[group],
                    };
                    d[column] * rendered
                });
                parts.sum()
            };
            let rendered = quantize_rows(SMALL, &by, anchor as u32, &row, mask, steps);
            let plain: f64 = rendered.iter().zip(&d).map(|(v, d)| v * d).sum();
            assert!((plain - loss(&row, widths)).abs() < 1e-9, "the loss is that of the rendered rows");
            let (d_row, d_log_steps) = quantize_gradient(SMALL, &by, anchor as u32, &row, mask, steps, &d);
            for (column, found) in d_row.iter().enumerate() {
                let at = |by: f64| {
                    let mut moved = row.clone();
                    moved[column] += by;
                    loss(&moved, widths)
                };
                let expected = (at(1e-6) - at(-1e-6)) / 2e-6;
                assert!((found - expected).abs() < 1e-8, "{phase:?} column {column}: {found} {expected}");
            }
            for (group, found) in d_log_steps.iter().enumerate() {
                let at = |by: f64| {
                    let mut moved = widths;
                    moved[group] *= by.exp2();
                    loss(&row, moved)
                };
                let expected = (at(1e-6) - at(-1e-6)) / 2e-6;
                assert!((found - expected).abs() < 1e-8, "{phase:?} group {group}: {found} {expected}");
            }
        }
    }
}

#[test]
fn a_scaling_below_its_step_is_one_step_and_can_only_be_asked_to_grow() {
    let by = quantization(QuantizationPhase::Rounded);
    let mut row = vec![0.5; SMALL.row()];
    let step = 0.02_f64;
    row[SMALL.scaling_column()] = (0.3 * step).ln();
    let steps = [1.0, step, 1.0];
    let rendered = quantize_rows(SMALL, &by, 0, &row, 0, steps);
    assert!((rendered[SMALL.scaling_column()] - step.ln()).abs() < 1e-12);
    for (sign, expected) in [(1.0, 0.0), (-1.0, -0.3)] {
        let mut d = vec![0.0; SMALL.row()];
        d[SMALL.scaling_column()] = sign;
        let (d_row, d_log_steps) = quantize_gradient(SMALL, &by, 0, &row, 0, steps, &d);
        assert!((d_row[SMALL.scaling_column()] - expected).abs() < 1e-12, "{d_row:?}");
        assert!((d_log_steps[1] - sign * std::f64::consts::LN_2).abs() < 1e-12, "it is the step");
    }
}

#[test]
fn the_kernels_match_the_twins() {
    let device = gpu();
    for (shape, count) in [(SMALL, 1), (SMALL, 70), (USUAL, 67)] {
        let case = Case::random(count as u64, shape, count, 0);
        let d_rendered = random_gradients(5, count * shape.row());
        for phase in PHASES {
            let by = quantization(phase);
            let uploaded = OnDevice::upload(&device, &case, &d_rendered);
            device.write(uploaded.quantized.rows(), &vec![JUNK; count * shape.row()]);
            device.write(uploaded.quantized.log_quant_step_gradients(), &vec![JUNK; 3 * count]);
            let mut recorder = device.recorder("quantize");
            uploaded.quantized.record_forward(&mut recorder, &uploaded.anchors, &by).expect("recorded");
            uploaded
                .quantized
                .record_backward(&mut recorder, &uploaded.anchors, &by, &uploaded.d_rows)
                .expect("recorded");
            recorder.submit().expect("submitted");
            let rows = device.read(uploaded.quantized.rows()).expect("read");
            let d_rows = device.read(&uploaded.d_rows).expect("read");
            let d_log_steps = device.read(uploaded.quantized.log_quant_step_gradients()).expect("read");
            let (mut expected_d, mut expected_log) = (Vec::new(), Vec::new());
            for anchor in 0..count {
                let row = f64s(case.anchors.row(anchor));
                let (mask, steps) = (case.anchors.masks[anchor], case.own_steps(anchor));
                let expected = quantize_rows(shape, &by, anchor as u32, &row, mask, steps);
                let found = &rows[anchor * shape.row()..][..shape.row()];
                for (column, (found, expected)) in found.iter().zip(&expected).enumerate() {
                    let error = (f64::from(*found) - expected).abs();
                    assert!(error < 2e-6 * expected.abs().max(1.0), "{phase:?} {column}: {found} {expected}");
                    let offset = column.checked_sub(shape.offset_column()).map(|at| at / 3);
                    if offset.is_some_and(|offset| mask >> offset & 1 == 0) {
                        assert_eq!(found.to_bits(), case.anchors.row(anchor)[column].to_bits());
                    }
                }
                let d = f64s(&d_rendered[anchor * shape.row()..][..shape.row()]);
                let (d_row, by_steps) = quantize_gradient(shape, &by, anchor as u32, &row, mask, steps, &d);
                expected_d.extend(d_row);
                expected_log.extend(by_steps);
            }
            assert!(relative_l2(&f64s(&d_rows), &expected_d) < 1e-5, "{phase:?}");
            assert!(relative_l2(&f64s(&d_log_steps), &expected_log) < 1e-4, "{phase:?}");
        }
    }
}

#[test]
fn rounded_values_are_a_files_bit_for_bit() {
    let device = gpu();
    let case = Case::random(8, USUAL, 50, 0);
    let quantized = QuantizedRows::upload(&device, USUAL, &case.steps).expect("room");
    let uploaded = OnDevice::upload(&device, &case, &[0.0; 4]);
    let mut recorder = device.recorder("quantize");
    let by = quantization(QuantizationPhase::Rounded);
    quantized.record_forward(&mut recorder, &uploaded.anchors, &by).expect("recorded");
    recorder.submit().expect("submitted");
    let rows = device.read(quantized.rows()).expect("read");
    for (i, found) in rows.iter().enumerate() {
        let (anchor, column) = (i / USUAL.row(), i % USUAL.row());
        if column < USUAL.features {
            let step = case.steps[3 * anchor];
            let expected = (case.anchors.values[i] / step).round_ties_even() * step;
            assert_eq!(found.to_bits(), expected.to_bits(), "{found} {expected}");
        }
    }
}
