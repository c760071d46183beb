//! Plain Gaussians as `.sog`, version 2: a zip of lossless WebP pictures with one pixel per Gaussian, and `meta.json`.
//!
//! Positions have 16 bits of `sign(x) ln(1 + |x|)`. Sizes and constant coefficients are indices into codebooks of 256 values. The other
//! coefficients of a Gaussian are one entry of a palette, whose values are indices into a codebook too: this and the eight bits of a
//! rotation's components are where the loss is. The same scene gives the same file.

mod codebook;
mod palette;
mod pictures;

use glam::Vec3;
use serde_json::json;
use thiserror::Error;

use self::{codebook::Codebook, palette::Palette, pictures::Pictures};
use super::opacity;
use crate::domain::{
    GaussianScene, anchors::SceneShapeError, gaussians::SH_COEFFICIENTS, harmonics::functions,
};

/// Opacities below this reach no pixel.
const ALPHA_MIN: f64 = 1.0 / 255.0;

/// A byte of 255 reads as an infinite logit; renderers hold opacities at 0.99 anyway.
const MAX_OPACITY_BYTE: f64 = 254.0;

/// Largest value of a position's 16 bits.
const POSITION_MAX: f64 = 65535.0;

/// The largest component of a rotation is named by the alpha byte from this on.
const LARGEST_FIRST: u8 = 252;

/// A file, and what was lost.
#[derive(Debug, Clone, PartialEq)]
pub struct SogFile {
    /// The zip.
    pub bytes: Vec<u8>,
    /// Gaussians as the file holds them, in its order.
    pub scene: GaussianScene,
    /// Gaussians that were left out since they are fainter than 1/255.
    pub left_out: usize,
}

/// Why a scene is not written.
#[derive(Debug, Error)]
pub enum SogError {
    /// Its parts do not fit together.
    #[error(transparent)]
    Scene(#[from] SceneShapeError),
    /// Not one Gaussian is visible.
    #[error("no Gaussian has an opacity of 1/255 or more")]
    Empty,
    /// A picture is too large for WebP, or memory does not suffice.
    #[error("a picture of the .sog cannot be written: {0}")]
    Picture(#[from] image::ImageError),
    /// The archive.
    #[error("the archive cannot be written: {0}")]
    Archive(#[from] zip::result::ZipError),
    /// The archive's memory.
    #[error("the archive cannot be written: {0}")]
    Io(#[from] std::io::Error),
}

/// The `.sog` file of a scene.
///
/// # Errors
/// [`SogError`].
pub fn to_sog(scene: &GaussianScene) -> Result<SogFile, SogError> {
    scene.check()?;
    let visible: Vec<usize> =
        (0..scene.len()).filter(|index| opacity(scene.opacity_logits[*index]) >= ALPHA_MIN).collect();
    if visible.is_empty() {
        return Err(SogError::Empty);
    }
    let left_out = scene.len() - visible.len();
    let positions = Positions::of(scene, &visible);
    let order = positions.in_space(scene, visible);
    let scales = Codebook::of(order.iter().flat_map(|index| scene.log_scales[*index]));
    let colors = Codebook::of(order.iter().flat_map(|index| scene.sh[*index][0]));
    let palette = (scene.degree > 0).then(|| Palette::of(scene, &order));

    let mut held = GaussianScene {
        degree: scene.degree,
        near: scene.near,
        frame: scene.frame,
        ..GaussianScene::default()
    };
    let mut pictures = Pictures::new(order.len());
    for (pixel, index) in order.iter().copied().enumerate() {
        let place = positions.rounded(scene.means[index]);
        pictures.low.set(pixel, [0, 1, 2].map(|axis| place[axis].to_le_bytes()[0]), 255);
        pictures.high.set(pixel, [0, 1, 2].map(|axis| place[axis].to_le_bytes()[1]), 255);
        held.means.push(positions.read(place));
        let sizes = scene.log_scales[index].map(|value| scales.nearest(value));
        pictures.scales.set(pixel, sizes, 255);
        held.log_scales.push(sizes.map(|code| scales.value(code)));
        let (parts, largest) = packed_rotation(scene.quats[index]);
        pictures.rotations.set(pixel, parts, LARGEST_FIRST + largest as u8);
        held.quats.push(read_rotation(parts, largest));
        let color = scene.sh[index][0].map(|value| colors.nearest(value));
        let alpha = (255.0 * opacity(scene.opacity_logits[index])).round().clamp(1.0, MAX_OPACITY_BYTE);
        pictures.colors.set(pixel, color, alpha as u8);
        held.opacity_logits.push((alpha / (255.0 - alpha)).ln() as f32);
        let mut sh = [[0.0; 3]; SH_COEFFICIENTS];
        sh[0] = color.map(|code| colors.value(code));
        if let Some(palette) = &palette {
            let label = palette.labels[pixel];
            let [low, high] = label.to_le_bytes();
            pictures.labels.set(pixel, [low, high, 0], 255);
            sh[1..functions(scene.degree)].copy_from_slice(&palette.read(label));
        }
        held.sh.push(sh);
    }

    let mut meta = json!({
        "version": 2,
        "asset": { "generator": concat!("tcgs ", env!("CARGO_PKG_VERSION")) },
        "count": order.len(),
        "means": {
            "mins": positions.min.to_array(),
            "maxs": positions.max.to_array(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": { "codebook": scales.values(), "files": ["scales.webp"] },
        "quats": { "files": ["quats.webp"] },
        "sh0": { "codebook": colors.values(), "files": ["sh0.webp"] },
    });
    if let Some(palette) = &palette {
        meta["shN"] = json!({
            "count": palette.len(),
            "bands": scene.degree,
            "codebook": palette.codebook.values(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        });
    }
    let bytes = pictures.archive(&meta.to_string(), palette.as_ref())?;
    Ok(SogFile { bytes, scene: held, left_out })
}

/// The range of positions after their logarithm.
struct Positions {
    min: Vec3,
    max: Vec3,
}

impl Positions {
    fn of(scene: &GaussianScene, kept: &[usize]) -> Self {
        let logarithms = kept.iter().map(|index| Vec3::from(scene.means[*index].map(logarithm)));
        let (min, max) = logarithms.fold((Vec3::MAX, Vec3::MIN), |(min, max), p| (min.min(p), max.max(p)));
        Self { min, max }
    }

    fn rounded(&self, mean: [f32; 3]) -> [u16; 3] {
        [0, 1, 2].map(|axis| {
            let (low, high) = (f64::from(self.min[axis]), f64::from(self.max[axis]));
            let share = (f64::from(logarithm(mean[axis])) - low) / (high - low).max(f64::MIN_POSITIVE);
            (POSITION_MAX * share.clamp(0.0, 1.0)).round() as u16
        })
    }

    fn read(&self, place: [u16; 3]) -> [f32; 3] {
        [0, 1, 2].map(|axis| {
            let (low, high) = (f64::from(self.min[axis]), f64::from(self.max[axis]));
            let logarithm = low + (high - low) * f64::from(place[axis]) / POSITION_MAX;
            (logarithm.signum() * (logarithm.abs().exp() - 1.0)) as f32
        })
    }

    /// Along a Morton curve: neighbors in space are neighbors in the pictures, which then pack better.
    fn in_space(&self, scene: &GaussianScene, mut kept: Vec<usize>) -> Vec<usize> {
        let spread =
            |value: u16| (0..16).fold(0_u64, |sum, bit| sum | u64::from(value >> bit & 1) << (3 * bit));
        kept.sort_by_cached_key(|index| {
            let [x, y, z] = self.rounded(scene.means[*index]).map(spread);
            (x | y << 1 | z << 2, *index)
        });
        kept
    }
}

fn logarithm(value: f32) -> f32 {
    (f64::from(value).signum() * f64::from(value).abs().ln_1p()) as f32
}

/// Three components in bytes, and the index of the largest in w, x, y, z, which is made positive and left out.
fn packed_rotation(quat: [f32; 4]) -> ([u8; 3], usize) {
    let wide = quat.map(f64::from);
    let length = wide.iter().map(|part| part * part).sum::<f64>().sqrt();
    let unit = if length > 0.0 { wide.map(|part| part / length) } else { [1.0, 0.0, 0.0, 0.0] };
    let largest = (1..4).fold(0, |best, k| if unit[k].abs() > unit[best].abs() { k } else { best });
    let byte = |k: usize| {
        let part = unit[k] * unit[largest].signum() * std::f64::consts::SQRT_2;
        (255.0 * (0.5 * part + 0.5)).round().clamp(0.0, 255.0) as u8
    };
    (others(largest).map(byte), largest)
}

fn read_rotation(parts: [u8; 3], largest: usize) -> [f32; 4] {
    let mut quat = [0.0; 4];
    for (k, byte) in others(largest).into_iter().zip(parts) {
        quat[k] = (f64::from(byte) / 255.0 - 0.5) * std::f64::consts::SQRT_2;
    }
    quat[largest] = (1.0 - quat.iter().map(|part| part * part).sum::<f64>()).max(0.0).sqrt();
    quat.map(|part| part as f32)
}

/// Indices of the components besides one.
fn others(largest: usize) -> [usize; 3] {
    [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]][largest]
}
