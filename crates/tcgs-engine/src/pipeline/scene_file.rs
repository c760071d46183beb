//! Reads and writes finished scenes in every format that jobs and commands accept.

use std::fmt::Display;

use crate::{
    codec::{self, DecodeLimits},
    domain::{
        AnchorScene, Background, ByteCounts, Digest, GaussianScene, Problem, ProblemType, Scene, SceneFormat,
    },
    export::{PlyNote, anchors, from_ply, from_spz, spz, to_ply},
};

/// A scene as read from a file.
#[derive(Debug, Clone)]
pub struct SceneFile {
    /// The file's format.
    pub format: SceneFormat,
    /// The scene.
    pub scene: Scene,
    /// The background that it was trained on; black for a `.spz`, and for a `.ply` of another program.
    pub background: Background,
    /// SHA-256 of the attributes: of anchors as `FORMAT.md` defines it; of plain Gaussians that of their `.ply` as this
    /// program writes it.
    pub decode_sha256: Digest,
    /// Digest of the dataset that it was trained on, if the file has it.
    pub dataset: Option<Digest>,
    /// Where the file's bytes go.
    pub byte_counts: ByteCounts,
}

/// Reads a file; its format is recognized by its content.
///
/// # Errors
/// A problem of status 422 that says what is wrong with the file.
pub fn read(bytes: &[u8]) -> Result<SceneFile, Problem> {
    match SceneFormat::of_bytes(bytes) {
        SceneFormat::Tcgs => read_tcgs(bytes),
        SceneFormat::Safetensors => read_anchors(bytes),
        SceneFormat::Ply => read_gaussians(bytes),
        format @ (SceneFormat::Spz | SceneFormat::Spz3) => read_packed_gaussians(bytes, format),
        format @ (SceneFormat::Glb | SceneFormat::Usda | SceneFormat::Sog) => Err(undecodable(format!(
            "a .{} is written and not read; take the file that it was exported from",
            format.extension()
        ))),
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
    anchors::write(scene, background, dataset)
        .map_err(|error| Problem::new(ProblemType::Internal, format!("the scene cannot be written: {error}")))
}

/// Writes the `3dgs` baseline: the `.ply` of the reference implementation, with the scene's frame and provenance in a comment. Programs that
/// skip the comment expect world units ([`crate::export::world`]).
#[must_use]
pub fn write_gaussians(scene: &GaussianScene, background: Background, dataset: Option<Digest>) -> Vec<u8> {
    PlyNote { background, dataset, near: scene.near, frame: scene.frame }.add_to(to_ply(scene))
}

fn read_tcgs(bytes: &[u8]) -> Result<SceneFile, Problem> {
    let byte_counts = codec::inspect(bytes).map_err(undecodable)?.byte_counts;
    let decoded = codec::decode(bytes, &DecodeLimits::default()).map_err(undecodable)?;
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
    let file = anchors::read(bytes).map_err(undecodable)?;
    Ok(SceneFile {
        format: SceneFormat::Safetensors,
        decode_sha256: codec::decode_digest(&file.scene),
        byte_counts: anchors::byte_counts(&file.scene, bytes.len() as u64),
        background: file.background,
        dataset: file.dataset,
        scene: Scene::Anchors(file.scene),
    })
}

fn read_gaussians(bytes: &[u8]) -> Result<SceneFile, Problem> {
    let mut scene = from_ply(bytes).map_err(undecodable)?;
    let note = PlyNote::find(bytes);
    scene.near = note.map_or(scene.near, |note| note.near);
    scene.frame = note.map_or(scene.frame, |note| note.frame);
    Ok(SceneFile {
        format: SceneFormat::Ply,
        decode_sha256: Digest::of(&to_ply(&scene)),
        byte_counts: ply_counts(&scene, bytes.len() as u64),
        background: note.map_or(Background::Black, |note| note.background),
        dataset: note.and_then(|note| note.dataset),
        scene: Scene::Gaussians(scene),
    })
}

fn read_packed_gaussians(bytes: &[u8], format: SceneFormat) -> Result<SceneFile, Problem> {
    let scene = from_spz(bytes).map_err(undecodable)?;
    let total = bytes.len() as u64;
    let byte_counts = if format == SceneFormat::Spz {
        let [positions, opacities, colors, scales, rotations, harmonics] =
            spz::packed_lengths(bytes).map_err(undecodable)?;
        let (features, scalings) = (opacities + colors + harmonics, scales + rotations);
        let container = total.saturating_sub(positions + features + scalings);
        ByteCounts { total, positions, features, scalings, container, ..ByteCounts::default() }
    } else {
        // One gzip stream: no byte belongs to one group.
        ByteCounts { total, container: total, ..ByteCounts::default() }
    };
    Ok(SceneFile {
        format,
        decode_sha256: Digest::of(&to_ply(&scene)),
        byte_counts,
        background: Background::Black,
        dataset: None,
        scene: Scene::Gaussians(scene),
    })
}

/// The bytes of a `.ply` in the attribute groups of anchors: means are positions, log-scales and rotations are scalings, spherical
/// harmonics and opacities are features; the rest, with the format's three unused normals, is the container.
fn ply_counts(scene: &GaussianScene, total: u64) -> ByteCounts {
    let floats = |each: u64| 4 * each * scene.len() as u64;
    let (positions, scalings) = (floats(3), floats(3 + 4));
    // A file of another program may omit bands that are zero; this one writes all of them.
    let features = floats(1 + 48).min(total.saturating_sub(positions + scalings));
    let container = total.saturating_sub(positions + scalings + features);
    ByteCounts { total, positions, features, scalings, container, ..ByteCounts::default() }
}

/// The problem of a file that cannot be decoded.
pub fn undecodable(cause: impl Display) -> Problem {
    Problem::new(ProblemType::Undecodable, cause.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        domain::{SceneFrame, gaussians::SH_COEFFICIENTS},
        export::world::{Origin, in_world_units},
    };

    #[test]
    fn a_scene_relative_to_an_offset_comes_back_in_its_place_however_small_it_is() {
        // A millimeter large, ten units from the origin.
        let frame = SceneFrame::around([10.0, 0.0, 0.0].into(), 1e-3).expect("a frame");
        let scene = GaussianScene {
            frame,
            means: vec![[0.5, -1.25, 0.1]],
            log_scales: vec![[-3.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![0.5],
            sh: vec![[[0.25; 3]; SH_COEFFICIENTS]],
            degree: 3,
            ..GaussianScene::default()
        };
        let scene = in_world_units(&scene, Origin::Nearby);
        assert_eq!(scene.frame.offset(), frame.offset(), "it is far out in its own lengths");
        let file = read(&write_gaussians(&scene, Background::Black, None)).expect("reads");
        assert_eq!(file.scene, Scene::Gaussians(scene));
    }
}
