//! The file that a finished scene is kept in, whichever kind it is, and the scene that is in a file.

use crate::{
    codec::{self, DecodeLimits},
    domain::{AnchorScene, Background, ByteCounts, Digest, Problem, Scene, SceneFormat},
    export::anchors,
};

/// What is in a file.
#[derive(Debug, Clone)]
pub struct SceneFile {
    /// The kind of file.
    pub format: SceneFormat,
    /// The scene.
    pub scene: Scene,
    /// The background that it was trained on.
    pub background: Background,
    /// SHA-256 of the attributes: of anchors as `FORMAT.md` defines it.
    pub decode_sha256: Digest,
    /// Digest of the dataset that it was trained on, if the file states it.
    pub dataset: Option<Digest>,
    /// Where the file's bytes go.
    pub byte_counts: ByteCounts,
}

/// Reads a file of any kind; its content tells which it is.
///
/// # Errors
/// A problem of status 422 that says what is wrong with the file.
pub fn read(bytes: &[u8]) -> Result<SceneFile, Problem> {
    match SceneFormat::of_bytes(bytes) {
        SceneFormat::Tcgs => read_tcgs(bytes),
        SceneFormat::Safetensors => read_anchors(bytes),
        SceneFormat::Ply => Err(undecodable("this version does not read .ply scenes")),
    }
}

/// Writes the `scaffold` baseline: anchors and networks as floats.
///
/// # Errors
/// A problem where the scene's parts do not fit together.
pub fn write_anchors(
    scene: &AnchorScene,
    background: Background,
    dataset: Option<Digest>,
) -> Result<Vec<u8>, Problem> {
    anchors::write(scene, background, dataset).map_err(|fault| {
        Problem::new(500, "internal", "Internal error", format!("the scene cannot be written: {fault}"))
    })
}

fn read_tcgs(bytes: &[u8]) -> Result<SceneFile, Problem> {
    let byte_counts = codec::inspect(bytes).map_err(|fault| undecodable(&fault.to_string()))?.byte_counts;
    let decoded =
        codec::decode(bytes, &DecodeLimits::default()).map_err(|fault| undecodable(&fault.to_string()))?;
    Ok(SceneFile {
        format: SceneFormat::Tcgs,
        scene: Scene::Anchors(decoded.scene),
        background: decoded.manifest.background,
        decode_sha256: decoded.decode_sha256,
        dataset: decoded.manifest.provenance.dataset,
        byte_counts,
    })
}

fn read_anchors(bytes: &[u8]) -> Result<SceneFile, Problem> {
    let file = anchors::read(bytes).map_err(|fault| undecodable(&fault.to_string()))?;
    Ok(SceneFile {
        format: SceneFormat::Safetensors,
        decode_sha256: codec::decode_digest(&file.scene),
        byte_counts: anchors::byte_counts(&file.scene, bytes.len() as u64),
        background: file.background,
        dataset: file.dataset,
        scene: Scene::Anchors(file.scene),
    })
}

/// A file that cannot be read.
pub fn undecodable(detail: &str) -> Problem {
    Problem::new(422, "undecodable", "The file cannot be decoded", detail)
}
