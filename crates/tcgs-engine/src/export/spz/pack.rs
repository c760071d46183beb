//! Rounds Gaussians to the integers of a `.spz` file and writes it.

use super::super::opacity;
use super::{
    COLOR_UNIT, FLIP, FLIP_ROTATION, POSITION_BITS, ROTATION_MAX, SpzError, SpzVersion,
    container::{self, Header},
    flip_harmonics, harmonic_step, rest,
};
use crate::domain::{GaussianScene, harmonics};

/// Fewest fractional bits if they fit: those of the format's own writer.
const DEFAULT_BITS: u32 = 12;

/// Position units to the median Gaussian's size, at least.
const UNITS_A_SIZE: f64 = 16.0;

/// Opacities below this reach no pixel.
const ALPHA_MIN: f64 = 1.0 / 255.0;

/// Opacity 255 reads as an infinite logit in other programs; renderers hold opacities at 0.99 anyway.
const MAX_OPACITY_BYTE: f64 = 254.0;

/// A file, and what was lost.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Packed {
    /// The file.
    pub bytes: Vec<u8>,
    /// Gaussians in it.
    pub gaussians: usize,
    /// Gaussians that were left out since they are fainter than 1/255 and so reach no pixel.
    pub left_out: usize,
    /// Positions are in units of two to the minus this.
    pub fractional_bits: u8,
    /// Values that were out of the format's range and held at its end.
    pub clamped: usize,
}

/// The `.spz` file of a scene. The same scene gives the same file.
///
/// # Errors
/// [`SpzError::Scene`], [`SpzError::TooMany`], [`SpzError::TooFar`]; [`SpzError::Gzip`] or [`SpzError::Zstd`] if memory does
/// not suffice.
pub fn to_spz(scene: &GaussianScene, version: SpzVersion) -> Result<Packed, SpzError> {
    scene.check()?;
    let kept: Vec<usize> =
        (0..scene.len()).filter(|index| opacity(scene.opacity_logits[*index]) >= ALPHA_MIN).collect();
    let count = u32::try_from(kept.len()).map_err(|_| SpzError::TooMany(kept.len()))?;
    let bits = fractional_bits(scene, &kept)?;

    let unit = f64::from(1_u32 << bits);
    let mut positions = Vec::with_capacity(9 * kept.len());
    for index in &kept {
        for (coordinate, flip) in scene.means[*index].into_iter().zip(FLIP) {
            let fixed = (f64::from(flip * coordinate) * unit).round() as i32;
            positions.extend(&fixed.to_le_bytes()[..3]);
        }
    }
    let opacities = kept
        .iter()
        .map(|index| (255.0 * opacity(scene.opacity_logits[*index])).round().min(MAX_OPACITY_BYTE) as u8)
        .collect();
    let mut rounder = Rounder { clamped: 0 };
    let (mut colors, mut scales) = (Vec::new(), Vec::new());
    for index in &kept {
        colors.extend(
            scene.sh[*index][0].map(|value| rounder.byte(f64::from(value) * COLOR_UNIT + 127.5, 1.0)),
        );
        scales.extend(
            scene.log_scales[*index].map(|value| rounder.byte((f64::from(value) + 10.0) * 16.0, 1.0)),
        );
    }
    let rotations = kept.iter().flat_map(|index| rotation(scene.quats[*index]).to_le_bytes()).collect();
    let signs = flip_harmonics();
    let mut above_constant = Vec::with_capacity(3 * rest(scene.degree) * kept.len());
    for index in &kept {
        let above = scene.sh[*index].iter().zip(signs).enumerate().skip(1);
        for (function, (rgb, sign)) in above.take(rest(scene.degree)) {
            let step = harmonic_step(harmonics::degree_of(function));
            above_constant
                .extend(rgb.map(|value| rounder.byte(f64::from(sign * value) * 128.0 + 128.0, step)));
        }
    }

    let header =
        Header { version: version.number(), count, degree: scene.degree, fractional_bits: bits, flags: 0 };
    let arrays = [positions, opacities, colors, scales, rotations, above_constant];
    Ok(Packed {
        bytes: container::write(version, header, &arrays)?,
        gaussians: kept.len(),
        left_out: scene.len() - kept.len(),
        fractional_bits: bits,
        clamped: rounder.clamped,
    })
}

/// Rounds to bytes and counts values out of range.
struct Rounder {
    clamped: usize,
}

impl Rounder {
    /// The multiple of `step` nearest to `value`, held in a byte.
    fn byte(&mut self, value: f64, step: f64) -> u8 {
        let rounded = (value / step).round() * step;
        // The last multiple below 256 is 255.
        self.clamped += usize::from(!(-0.5..=256.0).contains(&rounded));
        rounded.clamp(0.0, 255.0) as u8
    }
}

/// As fine a unit as sizes ask for, no coarser than the usual one, but coarse enough for the farthest Gaussian.
fn fractional_bits(scene: &GaussianScene, kept: &[usize]) -> Result<u8, SpzError> {
    let farthest = kept
        .iter()
        .map(|index| (*index, scene.means[*index].iter().fold(0.0_f32, |max, value| max.max(value.abs()))))
        .max_by(|a, b| a.1.total_cmp(&b.1));
    let Some((index, max)) = farthest else { return Ok(DEFAULT_BITS as u8) };
    let limit = f64::from((1_u32 << (POSITION_BITS - 1)) - 1);
    if f64::from(max) > limit {
        return Err(SpzError::TooFar { index, coordinate: max as i64 });
    }
    let mut sizes: Vec<f32> =
        kept.iter().map(|index| scene.log_scales[*index].iter().sum::<f32>() / 3.0).collect();
    let middle = sizes.len() / 2;
    let median = f64::from(*sizes.select_nth_unstable_by(middle, f32::total_cmp).1);
    let wanted = (UNITS_A_SIZE.log2() - median / std::f64::consts::LN_2).ceil();
    let most_bits = POSITION_BITS - 1;
    let mut bits = (wanted.clamp(f64::from(DEFAULT_BITS), f64::from(most_bits))) as u32;
    while (f64::from(max) * f64::from(1_u32 << bits)).round() > limit {
        bits -= 1;
    }
    Ok(bits as u8)
}

/// A rotation w, x, y, z as the largest component's index and the three others.
fn rotation(quat: [f32; 4]) -> u32 {
    let [w, x, y, z] = quat.map(f64::from);
    let length = (w * w + x * x + y * y + z * z).sqrt();
    let unit = if length > 0.0 { [x, y, z, w].map(|value| value / length) } else { [0.0, 0.0, 0.0, 1.0] };
    let unit = [unit[0] * FLIP_ROTATION[0], unit[1] * FLIP_ROTATION[1], unit[2] * FLIP_ROTATION[2], unit[3]];
    let largest = (1..4).fold(0, |best, k| if unit[k].abs() > unit[best].abs() { k } else { best });
    (0..4).filter(|k| *k != largest).fold(largest as u32, |word, k| {
        let magnitude = unit[k].abs() * std::f64::consts::SQRT_2 * f64::from(ROTATION_MAX);
        let magnitude = (magnitude.round() as u32).min(ROTATION_MAX);
        // The largest is read as positive; turning all four signs over leaves the rotation as it is.
        let negative = (unit[k] < 0.0) != (unit[largest] < 0.0);
        word << 10 | u32::from(negative) << 9 | magnitude
    })
}
