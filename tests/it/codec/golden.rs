//! A committed file and its decode hash: what was once written must be read the same for ever.
//!
//! A change here means that files in the world no longer decode, or decode to something else; raise the format's
//! major version instead. To make the file anew after such a change:
//! `cargo test --test it codec::golden::make -- --ignored`.

use std::{fs, path::PathBuf};

use tcgs::codec::{DecodeLimits, decode, encode};

use super::synthetic::{Recipe, scene, settings};

/// Hash of the decoded attributes of `tests/golden/shell_v1.tcgs`.
const DECODE_SHA256: &str = "158a5a29e6a6718810d158fab8dbed2197388d83e56902ff6786378b03cf603f";

fn path() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden/shell_v1.tcgs")
}

/// A scene that touches every part: masks, dropped anchors, escapes, a constant channel, negative cells.
fn golden_scene() -> tcgs::domain::AnchorScene {
    let mut scene = scene(Recipe { seed: 2024, anchors: 400, feature_dim: 8, offsets: 4, masked: 0.35 });
    scene.masks[40..44].fill(false);
    scene.offsets[100] = 12_345.6;
    scene.offsets[101] = -7.0e5;
    scene.features.iter_mut().skip(3).step_by(8).for_each(|value| *value = 2.0);
    scene
}

#[test]
fn the_golden_file_decodes_to_its_hash() {
    let bytes = fs::read(path()).expect("the golden file is committed");
    assert!(bytes.len() <= 20_000);
    let decoded = decode(&bytes, &DecodeLimits::default()).expect("decodes");
    assert_eq!(decoded.decode_sha256.to_string(), DECODE_SHA256);
    assert_eq!(decoded.scene.len(), 399);
}

#[test]
fn the_encoder_still_writes_the_golden_file() {
    let encoded = encode(&golden_scene(), None, &settings()).expect("encodes");
    assert_eq!(encoded.decode_sha256.to_string(), DECODE_SHA256);
    assert_eq!(encoded.bytes, fs::read(path()).expect("the golden file is committed"));
}

/// The lines `offset: hex  meaning` of FORMAT.md's example.
#[test]
fn the_documented_example_is_the_golden_file() {
    let format = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("FORMAT.md");
    let text = fs::read_to_string(format).expect("FORMAT.md is at the root");
    let bytes = fs::read(path()).expect("the golden file is committed");
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
#[ignore = "writes the golden file; only after a deliberate change of the format"]
fn make() {
    let encoded = encode(&golden_scene(), None, &settings()).expect("encodes");
    fs::write(path(), &encoded.bytes).expect("writable");
    println!("{} bytes, decode hash {}", encoded.bytes.len(), encoded.decode_sha256);
}
