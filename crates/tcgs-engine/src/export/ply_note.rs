//! A comment in the header of our `.ply` files, which other programs skip: background, dataset, near plane if it is not the default, and
//! the offset that coordinates are relative to, if there is one.

use serde::{Deserialize, Serialize};

use crate::domain::{Background, Digest, NearPlane, SceneFrame};

/// Start of the comment; JSON follows.
const MARK: &str = "comment tcgs ";

/// Where the comment goes: behind the line that names the format.
const BEFORE: &[u8] = b"\nelement ";

/// Longest header that is searched for a note.
const HEADER: usize = 1 << 14;

/// Properties of a scene that `.ply` has no field for.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PlyNote {
    /// The background that the scene was trained on.
    pub background: Background,
    /// Digest of the dataset.
    pub dataset: Option<Digest>,
    /// Near plane, as in training.
    #[serde(default, skip_serializing_if = "NearPlane::is_default")]
    pub near: NearPlane,
    /// Where the file's coordinates are in the world: add the offset to a position to get its place there.
    #[serde(default, skip_serializing_if = "SceneFrame::is_world")]
    pub frame: SceneFrame,
}

impl PlyNote {
    /// The same file with the note in its header.
    #[must_use]
    pub fn add_to(&self, ply: Vec<u8>) -> Vec<u8> {
        let text = serde_json::to_string(self).unwrap_or_default();
        let Some(at) = position(&ply, BEFORE) else { return ply };
        let mut noted = Vec::with_capacity(ply.len() + MARK.len() + text.len() + 1);
        noted.extend_from_slice(&ply[..=at]);
        noted.extend_from_slice(MARK.as_bytes());
        noted.extend_from_slice(text.as_bytes());
        noted.extend_from_slice(&ply[at..]);
        noted
    }

    /// The note of a file, if it has one that can be read.
    #[must_use]
    pub fn find(ply: &[u8]) -> Option<Self> {
        let end = position(ply, b"\nend_header")?;
        let header = std::str::from_utf8(&ply[..end]).ok()?;
        let text = header.lines().find_map(|line| line.strip_prefix(MARK))?;
        serde_json::from_str(text).ok()
    }
}

fn position(bytes: &[u8], wanted: &[u8]) -> Option<usize> {
    bytes[..bytes.len().min(HEADER)].windows(wanted.len()).position(|window| window == wanted)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        domain::GaussianScene,
        export::{from_ply, to_ply},
    };

    #[test]
    fn a_note_is_found_again_and_changes_no_gaussian() {
        let scene = GaussianScene {
            means: vec![[1.0, 2.0, 3.0]],
            log_scales: vec![[-1.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![0.5],
            sh: vec![[[0.25; 3]; 16]],
            degree: 3,
            ..GaussianScene::default()
        };
        let plain = to_ply(&scene);
        assert_eq!(PlyNote::find(&plain), None);
        let far = SceneFrame::new(glam::DVec3::new(5e5, 4e6, -0.5), 1.0).expect("a frame");
        for (dataset, near, frame) in [
            (None, NearPlane::default(), SceneFrame::WORLD),
            (Some(Digest::of(b"photographs")), NearPlane::of_extent(0.1), far),
        ] {
            let note = PlyNote { background: Background::White, dataset, near, frame };
            let noted = note.add_to(plain.clone());
            assert_eq!(PlyNote::find(&noted), Some(note));
            assert_eq!(from_ply(&noted).expect("a scene"), scene);
        }
    }

    #[test]
    fn what_is_no_note_is_none() {
        for text in ["", "ply\ncomment tcgs {\nend_header\n", "ply\ncomment tcgs 7\nelement vertex 0\n"] {
            assert_eq!(PlyNote::find(text.as_bytes()), None, "{text}");
        }
    }
}
