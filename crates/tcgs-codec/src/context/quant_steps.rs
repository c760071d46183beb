//! Quantization steps and distributions from a network's outputs: arithmetic profile 1.
//!
//! Steps differ from their base step by 7/32 of an octave times an index, the spacing of the 64 standard deviations. So an
//! index serves both: one more makes the step one entry coarser and the standard deviation, in steps, one entry smaller.

use crate::{gaussian::Gaussian, gaussian_constants::SCALES};

/// Largest magnitude of a step index: 3.5 octaves.
pub(crate) const MAX_STEP_INDEX: i8 = 16;

/// Table entries an octave, 32 / 7, for octaves in 2^-8, in 2^-16.
const ENTRIES_PER_OCTAVE: i64 = 1170;

/// Index of the standard deviation of one step.
const UNIT_SCALE: i64 = 16;

/// Largest magnitude of a mean, in sixteenths of a step.
pub(crate) const MAX_MEAN: i64 = 1 << 28;

/// `2^(7 j / 32)` for j from -16 to 16, as the nearest f32.
#[rustfmt::skip]
const STEP_TABLE: [f32; 33] = [
    0.088388346, 0.10285972, 0.11970041, 0.13929835, 0.16210495, 0.18864556, 0.21953152, 0.2554743,
    0.29730177, 0.3459775, 0.40262258, 0.46854192, 0.5452539, 0.6345255, 0.7384131, 0.8593097,
    1.0, 1.1637249, 1.3542556, 1.5759809, 1.8340081, 2.134281, 2.4837155, 2.8903615,
    3.3635857, 3.9142883, 4.5551543, 5.3009467, 6.1688433, 7.1788363, 8.35419, 9.721979,
    11.313708,
];

/// `round(2^(16 - 7 j / 32))` for j from -16 to 16: base steps to steps, in 2^-16.
const RATIO: [i64; 33] = [
    741_455, 637_140, 547_500, 470_472, 404_281, 347_403, 298_527, 256_527, 220_436, 189_423, 162_773,
    139_872, 120_194, 103_283, 88_752, 76_266, 65_536, 56_316, 48_393, 41_584, 35_734, 30_706, 26_386,
    22_674, 19_484, 16_743, 14_387, 12_363, 10_624, 9129, 7845, 6741, 5793,
];

/// Place of a step index in the tables; it is clamped to [`MAX_STEP_INDEX`].
fn entry(index: i8) -> usize {
    usize::from((index.clamp(-MAX_STEP_INDEX, MAX_STEP_INDEX) + MAX_STEP_INDEX).unsigned_abs())
}

/// The factor from the base step to the step of an index.
pub(crate) fn factor(index: i8) -> f32 {
    STEP_TABLE[entry(index)]
}

/// The index of the step nearest to `octaves` from the base step.
pub(crate) fn nearest_index(octaves: f32) -> i8 {
    let limit = f32::from(MAX_STEP_INDEX);
    (octaves * 32.0 / 7.0).round_ties_even().clamp(-limit, limit) as i8
}

/// What `coarser` step indices are as an output of a network: an index is 56 / 256 of an octave.
pub(crate) fn index_as_octaves(coarser: i8) -> i32 {
    i32::from(coarser) * 56
}

/// The step index of an adjustment in octaves, in 2^-8.
pub(crate) fn index(adjustment: i32) -> i8 {
    let index = (i64::from(adjustment) * ENTRIES_PER_OCTAVE + (1 << 15)) >> 16;
    index.clamp(-i64::from(MAX_STEP_INDEX), i64::from(MAX_STEP_INDEX)) as i8
}

/// The distribution of a symbol in steps of index `step_index`, from its mean in base steps and the base-2 logarithm of its
/// standard deviation in base steps, both in 2^-8 and at most 2^23 in magnitude.
pub(crate) fn gaussian(mean: i32, log_deviation: i32, step_index: i8) -> Gaussian {
    let ratio = RATIO[entry(step_index)];
    // Below 2^23 x 2^20, so the sum fits 64 bits with room to spare.
    let mean16 = ((i64::from(mean) * ratio + (1 << 19)) >> 20).clamp(-MAX_MEAN, MAX_MEAN);
    let scale = ((i64::from(log_deviation) * ENTRIES_PER_OCTAVE + (1 << 15)) >> 16) + UNIT_SCALE;
    let scale = (scale - i64::from(step_index)).clamp(0, SCALES as i64 - 1);
    Gaussian { mean16: mean16 as i32, scale: scale as u8 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_committed_tables_are_the_rounded_expressions() {
        for (place, (factor, ratio)) in STEP_TABLE.iter().zip(RATIO).enumerate() {
            let octaves = 7.0 * (place as f64 - 16.0) / 32.0;
            assert_eq!(*factor, libm::exp2(octaves) as f32, "{place}");
            assert_eq!(ratio as f64, libm::round(libm::exp2(16.0 - octaves)), "{place}");
        }
    }

    #[test]
    fn indices_are_the_nearest_and_clamped() {
        for adjustment in -1000..=1000 {
            let exact = f64::from(adjustment) / 256.0 * 32.0 / 7.0;
            let index = index(adjustment);
            // 1170 / 65536 is a three-thousandth below 32 / (7 x 256).
            assert!((f64::from(index) - exact.clamp(-16.0, 16.0)).abs() <= 0.504, "{adjustment}: {index}");
            assert_eq!(nearest_index(f32::from(index) * 7.0 / 32.0), index);
        }
        for coarser in -16..=16 {
            assert_eq!(index(index_as_octaves(coarser)), coarser);
        }
        assert_eq!((index(i32::MAX), index(i32::MIN)), (16, -16));
        assert_eq!((nearest_index(f32::INFINITY), nearest_index(f32::NAN)), (16, 0));
    }

    #[test]
    fn gaussians_are_the_predicted_ones_whatever_the_step() {
        for step in -MAX_STEP_INDEX..=MAX_STEP_INDEX {
            for (mean, deviation) in [(0, 0), (256, 256), (-12_345, 700), (40_000, -500), (1 << 20, 1500)] {
                let gaussian = gaussian(mean, deviation, step);
                let exact = f64::from(mean) / 256.0 * 16.0 / f64::from(factor(step));
                assert!((f64::from(gaussian.mean16) - exact).abs() <= 0.5 + exact.abs() * 1e-4);
                let sigma = f64::from(deviation) / 256.0 - 7.0 * f64::from(step) / 32.0;
                let exact = (16.0 + sigma * 32.0 / 7.0).clamp(0.0, 63.0);
                assert!((f64::from(gaussian.scale) - exact).abs() <= 0.52, "{deviation} {step}");
            }
        }
        for extreme in [i32::MIN, -(1 << 23), 1 << 23, i32::MAX] {
            for step in [i8::MIN, -16, 16, i8::MAX] {
                let gaussian = gaussian(extreme, extreme, step);
                assert!(gaussian.mean16.abs() <= 1 << 28 && usize::from(gaussian.scale) < SCALES);
            }
        }
    }
}
