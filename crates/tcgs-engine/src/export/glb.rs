//! Plain Gaussians as binary glTF 2.0 with the extension `KHR_gaussian_splatting`: every attribute is an array of floats.
//!
//! Positions and spherical harmonics are those of the scene bit for bit. Sizes and opacities are stored after activation and rotations
//! as unit quaternions x, y, z, w, as the extension demands. Coordinates are those of the `.ply`; glTF's upward axis is y. All floats are
//! finite and no array is empty, since glTF allows neither.

use serde_json::{Value, json};
use thiserror::Error;

use super::opacity;
use crate::domain::{
    GaussianScene,
    anchors::SceneShapeError,
    harmonics::{degree_of, functions},
};

/// The extension's name and the prefix of its attributes.
const EXTENSION: &str = "KHR_gaussian_splatting";

/// Constants of glTF.
const POINTS: u32 = 0;
const FLOAT: u32 = 5126;
const UNSIGNED_BYTE: u32 = 5121;
const ARRAY_BUFFER: u32 = 34962;

/// Gray plus the constant coefficient times this is the color that all directions share.
const CONSTANT: f32 = 0.282_094_8;

/// Why a scene is not written.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum GlbError {
    /// Its parts do not fit together.
    #[error(transparent)]
    Scene(#[from] SceneShapeError),
    /// Not one Gaussian is left.
    #[error("the scene has no Gaussian, and a .glb needs at least one")]
    Empty,
    /// Lengths in the file have 32 bits.
    #[error("{0} Gaussians take more than the 4 GiB of a .glb")]
    TooMany(usize),
}

/// The file of a scene.
///
/// # Errors
/// [`GlbError`].
pub fn to_glb(scene: &GaussianScene) -> Result<Vec<u8>, GlbError> {
    scene.check()?;
    let (min, max) = bounds(scene).ok_or(GlbError::Empty)?;
    let mut buffer = Buffer::new(scene.len());
    buffer.floats("POSITION", scene.means.iter().copied());
    if let Some(position) = buffer.accessors.last_mut() {
        position["min"] = json!(min);
        position["max"] = json!(max);
    }
    buffer.colors(scene);
    buffer.floats(&named("ROTATION"), scene.quats.iter().map(|quat| xyzw(*quat)));
    let size = |log: f32| log.exp().min(f32::MAX);
    buffer.floats(&named("SCALE"), scene.log_scales.iter().map(|logs| logs.map(size)));
    buffer.floats(&named("OPACITY"), scene.opacity_logits.iter().map(|logit| [opacity(*logit) as f32]));
    for function in 0..functions(scene.degree) {
        let degree = degree_of(function);
        let name = named(&format!("SH_DEGREE_{degree}_COEF_{}", function - usize::from(degree).pow(2)));
        buffer.floats(&name, scene.sh.iter().map(|row| row[function]));
    }
    let too_many = || GlbError::TooMany(scene.len());
    assembled(&buffer, scene).ok_or_else(too_many)
}

fn named(attribute: &str) -> String {
    format!("{EXTENSION}:{attribute}")
}

/// The unit quaternion; none for a length of zero, which renderers take for no rotation.
fn xyzw(quat: [f32; 4]) -> [f32; 4] {
    let [w, x, y, z] = quat.map(f64::from);
    let length = [w, x, y, z].iter().map(|part| part * part).sum::<f64>().sqrt();
    if length > 0.0 { [x, y, z, w].map(|part| (part / length) as f32) } else { [0.0, 0.0, 0.0, 1.0] }
}

/// Opposite corners of the box around the positions; `None` without any.
fn bounds(scene: &GaussianScene) -> Option<([f32; 3], [f32; 3])> {
    let first = scene.means.first()?;
    Some(scene.means.iter().fold((*first, *first), |(min, max), mean| {
        ([0, 1, 2].map(|axis| min[axis].min(mean[axis])), [0, 1, 2].map(|axis| max[axis].max(mean[axis])))
    }))
}

/// The binary part with the tables that describe it.
struct Buffer {
    count: usize,
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    attributes: serde_json::Map<String, Value>,
}

impl Buffer {
    fn new(count: usize) -> Self {
        let (bytes, views, accessors) = (Vec::new(), Vec::new(), Vec::new());
        Self { count, bytes, views, accessors, attributes: serde_json::Map::new() }
    }

    /// An attribute of `N` floats per Gaussian.
    fn floats<const N: usize>(&mut self, name: &str, rows: impl Iterator<Item = [f32; N]>) {
        let start = self.bytes.len();
        rows.flatten().for_each(|value| self.bytes.extend(value.to_le_bytes()));
        let kind = ["", "SCALAR", "VEC2", "VEC3", "VEC4"][N];
        self.describe(name, start, json!({ "componentType": FLOAT, "type": kind }));
    }

    /// Colors and opacities for programs that know points alone.
    fn colors(&mut self, scene: &GaussianScene) {
        let start = self.bytes.len();
        let byte = |value: f32| (255.0 * value.clamp(0.0, 1.0)).round() as u8;
        for (row, logit) in scene.sh.iter().zip(&scene.opacity_logits) {
            self.bytes.extend(row[0].map(|value| byte(0.5 + CONSTANT * value)));
            self.bytes.push(byte(opacity(*logit) as f32));
        }
        self.describe(
            "COLOR_0",
            start,
            json!({ "componentType": UNSIGNED_BYTE, "type": "VEC4", "normalized": true }),
        );
    }

    fn describe(&mut self, name: &str, start: usize, mut accessor: Value) {
        let length = self.bytes.len() - start;
        self.views
            .push(json!({ "buffer": 0, "byteOffset": start, "byteLength": length, "target": ARRAY_BUFFER }));
        accessor["bufferView"] = self.accessors.len().into();
        accessor["count"] = self.count.into();
        self.attributes.insert(name.to_owned(), self.accessors.len().into());
        self.accessors.push(accessor);
    }
}

/// Header and chunks; `None` where lengths do not fit in 32 bits.
fn assembled(buffer: &Buffer, scene: &GaussianScene) -> Option<Vec<u8>> {
    const HEADER: usize = 12;
    const CHUNK_HEADER: usize = 8;
    let splatting = json!({
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    });
    let mut node = json!({ "mesh": 0 });
    let offset = scene.frame.offset();
    if offset != glam::DVec3::ZERO {
        node["extras"] = json!({ "world_offset": offset.to_array() });
    }
    let document = json!({
        "asset": { "version": "2.0", "generator": concat!("tcgs ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [node],
        "meshes": [{ "primitives": [{
            "mode": POINTS,
            "attributes": buffer.attributes,
            "extensions": { EXTENSION: splatting },
        }] }],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{ "byteLength": buffer.bytes.len() }],
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = HEADER + CHUNK_HEADER + text.len() + CHUNK_HEADER + buffer.bytes.len();
    let (length, text_length) = (u32::try_from(length).ok()?, u32::try_from(text.len()).ok()?);
    let binary_length = u32::try_from(buffer.bytes.len()).ok()?;
    let mut file = Vec::with_capacity(length as usize);
    file.extend(b"glTF");
    file.extend(2_u32.to_le_bytes());
    file.extend(length.to_le_bytes());
    for (kind, size, chunk) in [(b"JSON", text_length, &text), (b"BIN\0", binary_length, &buffer.bytes)] {
        file.extend(size.to_le_bytes());
        file.extend(kind);
        file.extend(chunk);
    }
    Some(file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::gaussians::SH_COEFFICIENTS;

    #[test]
    fn a_scene_without_gaussians_is_refused() {
        assert_eq!(to_glb(&GaussianScene::default()), Err(GlbError::Empty));
    }

    #[test]
    fn sizes_beyond_single_precision_are_its_largest_number() {
        let scene = GaussianScene {
            means: vec![[0.0; 3]],
            log_scales: vec![[89.0, 0.0, -200.0]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![0.0],
            sh: vec![[[0.0; 3]; SH_COEFFICIENTS]],
            ..GaussianScene::default()
        };
        let file = to_glb(&scene).expect("writes");
        let sizes = [f32::MAX, 1.0, 0.0].map(f32::to_le_bytes).concat();
        assert!(file.windows(sizes.len()).any(|window| window == sizes));
    }
}
