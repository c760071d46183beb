//! Position inputs: coordinates and triangle waves of them, which let a small network distinguish places.

use crate::domain::context_model::{POSITION_INPUTS, POSITION_OCTAVES};

/// One wave's length, in 2^-16: as wide as all coordinates together.
const PERIOD: i32 = 1 << 18;

/// Inputs of a coordinate, in 2^-8: for each axis the coordinate (at most 2 in magnitude), then triangle waves of 2, 4,
/// ... 32 periods across the range of coordinates (at most 1 in magnitude).
#[must_use]
pub fn position_inputs(coordinate: [i32; 3]) -> [i16; POSITION_INPUTS] {
    let per_axis = 1 + POSITION_OCTAVES;
    std::array::from_fn(|input| {
        let v = coordinate[input / per_axis].clamp(-super::COORDINATE_LIMIT, super::COORDINATE_LIMIT);
        let value = match input % per_axis {
            0 => v,
            octave => ((v << octave).rem_euclid(PERIOD) - PERIOD / 2).abs() - PERIOD / 4,
        };
        (value >> 8) as i16
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::COORDINATE_LIMIT;

    #[test]
    fn waves_are_triangles_of_doubling_frequency() {
        for v in (-COORDINATE_LIMIT..=COORDINATE_LIMIT).step_by(37) {
            let inputs = position_inputs([v, 0, -v]);
            assert_eq!(i32::from(inputs[0]), v >> 8);
            assert_eq!(i32::from(inputs[12]), -v >> 8);
            for (octave, wave) in (0..=POSITION_OCTAVES).zip(inputs).skip(1) {
                // A triangle that is 1 at zero and -1 half a period on.
                let phase = f64::from(v) / 65536.0 * f64::from(1 << octave) / 4.0;
                let exact = 4.0 * (phase - libm::floor(phase) - 0.5).abs() - 1.0;
                let wave = f64::from(wave) / 256.0;
                assert!((wave - exact).abs() <= 1.0 / 256.0, "{v} octave {octave}: {wave} for {exact}");
            }
        }
    }

    #[test]
    fn ranges_hold_at_the_rim_and_for_any_argument() {
        for v in [0, COORDINATE_LIMIT, -COORDINATE_LIMIT, i32::MAX, i32::MIN] {
            let inputs = position_inputs([v; 3]);
            for (index, input) in inputs.into_iter().enumerate() {
                let limit = if index % 6 == 0 { 512 } else { 256 };
                assert!(input.abs() <= limit, "{v}: {inputs:?}");
            }
        }
    }
}
