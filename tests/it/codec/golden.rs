//! Committed files and their decode hashes: what was once written must be read the same for ever.
//!
//! Together they have every kind of section and every kind of context. A change here means that files in the world no
//! longer decode, or decode to something else; raise the format's major version instead. To make the files anew after such a
//! change: `cargo test --test it codec::golden::make -- --ignored --nocapture`.

use std::{collections::BTreeSet, fs, path::PathBuf};

use tcgs::{
    codec::{DecodeLimits, Encoded, decode, encode, inspect},
    domain::{AnchorScene, ContextKind, DistanceUnit, NearPlane, Planes},
};

use super::{
    context::fixed,
    dependent::{KINDS, dependent},
    synthetic::{Recipe, scene, settings},
};

/// A committed file.
struct Golden {
    name: &'static str,
    /// Hash of its decoded attributes.
    decode_sha256: &'static str,
    anchors: usize,
    make: fn() -> Encoded,
}

const FILES: [Golden; 4] = [
    Golden {
        name: "shell_v1.tcgs",
        decode_sha256: "e27f4bd5e0657803a95a4a53821172000f1b14e857aa9cd41875756e8ba0b75a",
        anchors: 399,
        make: shell,
    },
    Golden {
        name: "context_v1.tcgs",
        decode_sha256: "88337fea6b773ff00934537b2b6390790b3de3ff773891bf2a40e09efba7a62c",
        anchors: 90,
        make: context,
    },
    Golden {
        name: "direct_v1.tcgs",
        decode_sha256: "7a0ce6c96aebe558d35a71d9a10092553ad585ae3427f509c742354971dddcb3",
        anchors: 60,
        make: direct,
    },
    Golden {
        name: "unit_v1.tcgs",
        decode_sha256: "ec8bf1282b00d9ad754415674c3ee3ca4dc706f44171dbf8eb2ee07ee9215969",
        anchors: 40,
        make: unit,
    },
];

/// That of the file that has one, in world units.
const UNIT: f32 = 0.0025;

impl Golden {
    fn path(&self) -> PathBuf {
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(self.name)
    }

    fn bytes(&self) -> Vec<u8> {
        fs::read(self.path()).expect("the golden file is committed")
    }
}

/// The committed files.
pub(super) fn files() -> Vec<Vec<u8>> {
    FILES.iter().map(Golden::bytes).collect()
}

/// Tables for every group; masks, dropped anchors, escapes, a constant channel, negative cells.
fn shell() -> Encoded {
    let mut scene: AnchorScene =
        scene(Recipe { seed: 2024, anchors: 400, feature_dim: 8, offsets: 4, masked: 0.35 });
    scene.masks[40..44].fill(false);
    scene.offsets[100] = 12_345.6;
    scene.offsets[101] = -7.0e5;
    scene.features.iter_mut().skip(3).step_by(8).for_each(|value| *value = 2.0);
    encode(&scene, None, &settings()).expect("encodes")
}

/// A network of another kind for each group, and planes with an up-sampling layer.
fn context() -> Encoded {
    let recipe = Recipe { seed: 2025, anchors: 90, feature_dim: 5, offsets: 2, masked: 0.3 };
    let dependent = dependent(recipe);
    encode(&dependent.scene, Some(&dependent.candidates), &fixed(KINDS.map(Some), Some(0))).expect("encodes")
}

/// Planes that are stored as they are, and a near plane of its own.
fn direct() -> Encoded {
    let recipe = Recipe { seed: 2026, anchors: 60, feature_dim: 5, offsets: 2, masked: 0.3 };
    let mut dependent = dependent(recipe);
    let planes = &mut dependent.candidates.planes[0].planes;
    let (edge, channels) = (planes.plane_edge(), planes.plane_channels());
    let wave = |index: usize| ((index * 37 % 101) as f32 - 50.0) / 16.0;
    let latents = (0..3 * channels * edge * edge).map(wave).collect();
    *planes = Planes { edge, channels, latents, layers: Vec::new() };
    dependent.scene.near = NearPlane::new(0.0125).expect("a depth");
    encode(&dependent.scene, Some(&dependent.candidates), &fixed(KINDS.map(Some), Some(0))).expect("encodes")
}

/// Networks that are told distances in a unit of the scene's own.
fn unit() -> Encoded {
    let scene = scene(Recipe { seed: 2027, anchors: 40, feature_dim: 4, offsets: 2, masked: 0.3 });
    let unit = DistanceUnit::new(UNIT).expect("a length");
    encode(&AnchorScene { unit, ..scene }, None, &settings()).expect("encodes")
}

#[test]
fn the_golden_files_decode_to_their_hashes() {
    for golden in FILES {
        let bytes = golden.bytes();
        assert!(bytes.len() <= 8000, "{} has {} bytes", golden.name, bytes.len());
        let decoded = decode(&bytes, &DecodeLimits::default()).expect("decodes");
        assert_eq!(decoded.decode_sha256.to_string(), golden.decode_sha256, "{}", golden.name);
        assert_eq!(decoded.scene.len(), golden.anchors, "{}", golden.name);
        let unit = if golden.name == "unit_v1.tcgs" { UNIT } else { 1.0 };
        assert_eq!(decoded.scene.unit.length(), unit, "{}", golden.name);
    }
}

#[test]
fn the_golden_files_have_every_section_and_every_context() {
    let mut sections = BTreeSet::new();
    let mut contexts: Vec<Option<ContextKind>> = Vec::new();
    for golden in FILES {
        let inspection = inspect(&golden.bytes()).expect("inspects");
        sections.extend(inspection.sections.into_iter().map(|section| section.name));
        contexts.extend(inspection.manifest.contexts.map(|context| context.kind));
    }
    let all =
        ["manifest", "networks", "positions", "masks", "context", "planes", "attributes", "unit", "view"];
    assert_eq!(sections, all.map(str::to_owned).into());
    for kind in KINDS.map(Some).into_iter().chain([None]) {
        assert!(contexts.contains(&kind), "{kind:?}");
    }
}

#[test]
fn the_encoder_still_writes_the_golden_files() {
    for golden in FILES {
        let encoded = (golden.make)();
        assert_eq!(encoded.decode_sha256.to_string(), golden.decode_sha256, "{}", golden.name);
        assert!(encoded.bytes == golden.bytes(), "{}: other bytes", golden.name);
    }
}

/// The lines `offset: hex  meaning` of FORMAT.md's example.
#[test]
fn the_documented_example_is_a_golden_file() {
    let format = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("FORMAT.md");
    let text = fs::read_to_string(format).expect("FORMAT.md is at the root");
    let bytes = FILES[0].bytes();
    let mut lines = 0;
    for line in text.lines() {
        let Some((offset, rest)) = line.split_once(": ") else { continue };
        let Ok(offset) = usize::from_str_radix(offset, 16) else { continue };
        let hex: String = rest.split("  ").next().unwrap_or("").replace([' ', '.'], "");
        let documented: Vec<u8> = (0..hex.len() / 2)
            .map(|index| u8::from_str_radix(&hex[2 * index..2 * index + 2], 16).expect("hex"))
            .collect();
        assert_eq!(bytes[offset..offset + documented.len()], documented, "{line}");
        lines += 1;
    }
    assert!(lines >= 20, "{lines} lines");
}

#[test]
#[ignore = "writes the golden files; only after a deliberate change of the format"]
fn make() {
    for golden in FILES {
        let encoded = (golden.make)();
        fs::write(golden.path(), &encoded.bytes).expect("writable");
        println!("{}: {} bytes, decode hash {}", golden.name, encoded.bytes.len(), encoded.decode_sha256);
    }
}
