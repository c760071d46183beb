//! Reads a `.spz` file back into Gaussians.

use std::io::Read as _;

use flate2::read::GzDecoder;

use super::{
    COLOR_UNIT, FLIP, FLIP_ROTATION, HEADER, MAGIC, POSITION_BITS, ROTATION_MAX, SpzError, flip_harmonics,
    rest, strides,
};
use crate::domain::{GaussianScene, gaussians::SH_COEFFICIENTS};

/// No deflated byte stands for more: what a count may claim is bounded by what is there.
const MOST_EXPANSION: u64 = 1032;

/// Vendors' extensions are present.
const HAS_EXTENSIONS: u8 = 2;

/// Opacities 0 and 255 would have infinite logits; they read as if they lay this far from the ends.
const OPACITY_MARGIN: f64 = 1e-4;

/// Reads a file of version 2 or 3.
///
/// # Errors
/// [`SpzError`], one variant a fault.
pub fn from_spz(bytes: &[u8]) -> Result<GaussianScene, SpzError> {
    if let [b'N', b'G', b'S', b'P', a, b, c, d, ..] = bytes {
        // From version 4 on the header lies bare.
        return Err(SpzError::Version(u32::from_le_bytes([*a, *b, *c, *d])));
    }
    let mut gzip = GzDecoder::new(bytes);
    let fault = |fault: std::io::Error| SpzError::Gzip(fault.to_string());
    let mut header = [0; HEADER];
    gzip.read_exact(&mut header).map_err(fault)?;
    let word = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    let (version, count, degree, bits, flags) = (word(4), word(8), header[12], header[13], header[14]);
    if header[..4] != MAGIC {
        return Err(SpzError::NotSpz);
    }
    if !matches!(version, 2 | 3) {
        return Err(SpzError::Version(version));
    }
    if degree > 3 {
        return Err(SpzError::Degree(degree));
    }
    if u32::from(bits) >= POSITION_BITS {
        return Err(SpzError::FractionalBits(bits));
    }
    if flags & HAS_EXTENSIONS != 0 {
        return Err(SpzError::Extensions(flags));
    }
    let strides = strides(version, degree);
    let needed = u64::from(count) * strides.iter().sum::<usize>() as u64;
    let length = |found: u64| SpzError::Length { count, needed, found };
    let most = MOST_EXPANSION * bytes.len() as u64;
    if needed > most {
        return Err(length(most));
    }
    let mut payload = Vec::with_capacity(needed as usize + 1);
    gzip.take(needed + 1).read_to_end(&mut payload).map_err(fault)?;
    if payload.len() as u64 != needed {
        return Err(length(payload.len() as u64));
    }

    let count = count as usize;
    let mut left = payload.as_slice();
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
        scene.quats.push(match *rotation_bytes(rotations, index, strides[4]) {
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

fn rotation_bytes(rotations: &[u8], index: usize, stride: usize) -> &[u8] {
    &rotations[stride * index..][..stride]
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
