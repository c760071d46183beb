//! Reads a `.spz` file back into Gaussians.

use super::{
    ARRAYS, COLOR_UNIT, FLIP, FLIP_ROTATION, ROTATION_MAX, SpzError, container, flip_harmonics, rest, strides,
};
use crate::domain::{GaussianScene, gaussians::SH_COEFFICIENTS};

/// Opacities 0 and 255 would have infinite logits; they read as if they lay this far from the ends.
const OPACITY_MARGIN: f64 = 1e-4;

/// Bytes of each array in a file of version 4, packed, in the file's order.
///
/// # Errors
/// [`SpzError`], one variant for each thing that can be wrong. Files of earlier versions have one stream for all arrays and are refused.
pub fn packed_lengths(bytes: &[u8]) -> Result<[u64; ARRAYS], SpzError> {
    let (_, frames) = container::frames(bytes)?;
    Ok(frames.map(|frame| frame.len() as u64))
}

/// Reads a file of version 2, 3 or 4.
///
/// # Errors
/// [`SpzError`], one variant for each thing that can be wrong.
pub fn from_spz(bytes: &[u8]) -> Result<GaussianScene, SpzError> {
    let (header, arrays) = container::read(bytes)?;
    let (degree, bits) = (header.degree, header.fractional_bits);
    let strides = strides(header.version, degree);
    let count = header.count as usize;
    let mut left = arrays.as_slice();
    let [positions, opacities, colors, scales, rotations, harmonics] = strides.map(|stride| {
        let (part, rest) = left.split_at(stride * count);
        left = rest;
        part
    });
    let unit = (-f64::from(bits)).exp2();
    let signs = flip_harmonics();
    let above = 3 * rest(degree);
    let mut scene = GaussianScene { degree, ..GaussianScene::default() };
    scene.sh.reserve_exact(count);
    for (index, opacity) in opacities.iter().enumerate() {
        let position = &positions[9 * index..][..9];
        scene.means.push(std::array::from_fn(|axis| {
            let [low, middle, high] = [0, 1, 2].map(|byte| position[3 * axis + byte]);
            let fixed = i32::from_le_bytes([0, low, middle, high]) >> 8;
            FLIP[axis] * (f64::from(fixed) * unit) as f32
        }));
        scene.log_scales.push(std::array::from_fn(|axis| f32::from(scales[3 * index + axis]) / 16.0 - 10.0));
        scene.quats.push(match rotations[strides[4] * index..][..strides[4]] {
            [a, b, c, d] => smallest_three(u32::from_le_bytes([a, b, c, d])),
            [a, b, c] => first_three([a, b, c]),
            _ => [1.0, 0.0, 0.0, 0.0],
        });
        let opacity = (f64::from(*opacity) / 255.0).clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
        scene.opacity_logits.push((opacity / (1.0 - opacity)).ln() as f32);
        let mut sh = [[0.0; 3]; SH_COEFFICIENTS];
        sh[0] = std::array::from_fn(|channel| {
            ((f64::from(colors[3 * index + channel]) - 127.5) / COLOR_UNIT) as f32
        });
        for (at, value) in harmonics[above * index..][..above].iter().enumerate() {
            let (function, channel) = (at / 3 + 1, at % 3);
            sh[function][channel] = signs[function] * (f32::from(*value) - 128.0) / 128.0;
        }
        scene.sh.push(sh);
    }
    Ok(scene)
}

/// w, x, y, z in the scene's frame from x, y, z, w in the file's.
fn in_our_frame([x, y, z, w]: [f64; 4]) -> [f32; 4] {
    let [fx, fy, fz] = FLIP_ROTATION;
    [w, fx * x, fy * y, fz * z].map(|value| value as f32)
}

fn smallest_three(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut quat = [0.0; 4];
    let mut shift = 30;
    for (k, value) in quat.iter_mut().enumerate() {
        if k != largest {
            shift -= 10;
            let part = word >> shift;
            let magnitude = f64::from(part & ROTATION_MAX) / f64::from(ROTATION_MAX);
            let sign = if part >> 9 & 1 == 1 { -1.0 } else { 1.0 };
            *value = sign * magnitude * std::f64::consts::FRAC_1_SQRT_2;
        }
    }
    let squares: f64 = quat.iter().map(|value| value * value).sum();
    quat[largest] = (1.0 - squares).max(0.0).sqrt();
    in_our_frame(quat)
}

fn first_three(bytes: [u8; 3]) -> [f32; 4] {
    let [x, y, z] = bytes.map(|byte| f64::from(byte) / 127.5 - 1.0);
    let w = (1.0 - x * x - y * y - z * z).max(0.0).sqrt();
    in_our_frame([x, y, z, w])
}
