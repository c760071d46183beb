//! The formats of scene files, recognized by their first bytes.

use super::{ModelKind, choice::named_choice};

/// First bytes of a `.tcgs` file (FORMAT.md).
const TCGS: &[u8] = b"\x89TCGS";

/// First bytes of a `.spz` file from version 4 on.
const SPZ: &[u8] = b"NGSP";

/// First bytes of a `.glb` and of a `.usda` file.
const GLB: &[u8] = b"glTF";
const USDA: &[u8] = b"#usda";

/// First bytes of a `.spz` file up to version 3: those of gzip.
const SPZ3: &[u8] = b"\x1f\x8b";

named_choice! {
    /// A kind of file.
    pub enum SceneFormat {
        /// Compressed anchors.
        Tcgs = "tcgs",
        /// Anchors and networks as floats.
        Safetensors = "safetensors",
        /// Plain Gaussians as floats.
        Ply = "ply",
        /// Plain Gaussians as small integers, version 4. For exports only.
        Spz = "spz",
        /// The same integers in version 3, for viewers that read no later one.
        Spz3 = "spz3",
        /// Plain Gaussians as floats in binary glTF. Written, not read.
        Glb = "glb",
        /// Plain Gaussians as USD text. Written, not read.
        Usda = "usda",
        /// Plain Gaussians as pictures in a zip. Written, not read.
        Sog = "sog",
    }
}

impl SceneFormat {
    /// The formats of plain Gaussians, which scenes are exported to.
    pub const EXPORTS: [SceneFormat; 6] = [
        SceneFormat::Ply,
        SceneFormat::Spz,
        SceneFormat::Spz3,
        SceneFormat::Glb,
        SceneFormat::Usda,
        SceneFormat::Sog,
    ];

    /// The extension of a file's name.
    #[must_use]
    pub fn extension(self) -> &'static str {
        match self {
            SceneFormat::Spz3 => SceneFormat::Spz.name(),
            format => format.name(),
        }
    }

    /// The media type: the registered one, the project's own for `.tcgs`, else that of bytes.
    #[must_use]
    pub fn media_type(self) -> &'static str {
        match self {
            SceneFormat::Tcgs => "application/vnd.tcgs",
            SceneFormat::Glb => "model/gltf-binary",
            SceneFormat::Usda => "model/vnd.usda",
            SceneFormat::Safetensors
            | SceneFormat::Ply
            | SceneFormat::Spz
            | SceneFormat::Spz3
            | SceneFormat::Sog => "application/octet-stream",
        }
    }

    /// The format in which a trained model is written.
    #[must_use]
    pub fn of_model(model: ModelKind) -> Self {
        match model {
            ModelKind::Tcgs => SceneFormat::Tcgs,
            ModelKind::Scaffold => SceneFormat::Safetensors,
            ModelKind::Gaussians3d => SceneFormat::Ply,
        }
    }

    /// The format of a file by its first bytes. Anything unknown counts as `.tcgs`, whose reader describes best what is wrong.
    #[must_use]
    pub fn of_bytes(bytes: &[u8]) -> Self {
        // Safetensors begin with the length of a JSON object in eight bytes, and the object.
        let holds_object = bytes.get(8) == Some(&b'{');
        match bytes {
            _ if bytes.starts_with(TCGS) => SceneFormat::Tcgs,
            _ if bytes.starts_with(SPZ) => SceneFormat::Spz,
            _ if bytes.starts_with(GLB) => SceneFormat::Glb,
            _ if bytes.starts_with(USDA) => SceneFormat::Usda,
            _ if bytes.starts_with(SPZ3) => SceneFormat::Spz3,
            [b'p', b'l', b'y', b'\n' | b'\r', ..] => SceneFormat::Ply,
            _ if holds_object => SceneFormat::Safetensors,
            _ => SceneFormat::Tcgs,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_told_apart_by_what_they_begin_with() {
        for (bytes, format) in [
            (&b"\x89TCGS\r\n\x1a\x01"[..], SceneFormat::Tcgs),
            (b"ply\nformat binary_little_endian 1.0\n", SceneFormat::Ply),
            (b"ply\r\nformat ascii 1.0\r\n", SceneFormat::Ply),
            (b"\x40\0\0\0\0\0\0\0{\"cells\":", SceneFormat::Safetensors),
            (b"\x1f\x8b\x08\0\0\0\0\0{", SceneFormat::Spz3),
            (b"NGSP\x04\0\0\0", SceneFormat::Spz),
            (b"glTF\x02\0\0\0", SceneFormat::Glb),
            (b"#usda 1.0\n(", SceneFormat::Usda),
            (b"plyometrics", SceneFormat::Tcgs),
            (b"", SceneFormat::Tcgs),
        ] {
            assert_eq!(SceneFormat::of_bytes(bytes), format, "{bytes:?}");
        }
    }

    #[test]
    fn every_model_has_a_kind_of_its_own_and_names_are_those_of_the_api() {
        let mut kinds: Vec<SceneFormat> =
            ModelKind::ALL.iter().map(|model| SceneFormat::of_model(*model)).collect();
        kinds.extend([
            SceneFormat::Spz,
            SceneFormat::Spz3,
            SceneFormat::Glb,
            SceneFormat::Usda,
            SceneFormat::Sog,
        ]);
        assert_eq!(kinds, SceneFormat::ALL);
        for format in SceneFormat::ALL {
            assert_eq!(serde_json::to_value(format).expect("a name"), format.name());
            assert!(format.name().starts_with(format.extension()));
        }
    }
}
