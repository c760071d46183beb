//! Bytes from an enemy: an error or the same scene, never a panic, a hang or a large allocation.

use proptest::prelude::*;
use tcgs_codec::{DecodeLimits, decode, encode, inspect};

use super::{
    fixtures::tiny_context_file,
    synthetic::{settings, small, tiny},
    wire,
};

const LIMITS: DecodeLimits = DecodeLimits {
    max_file_bytes: 1 << 20,
    max_anchors: 100_000,
    max_memory_bytes: 64 << 20,
    max_expansion: 4096,
};

fn tiny_file() -> Vec<u8> {
    encode(&tiny(), None, &settings()).expect("encodes").bytes
}

pub(super) fn tiny_files() -> [Vec<u8>; 2] {
    [tiny_file(), tiny_context_file()]
}

/// Checksums hold again, so that what lies behind them is reached.
fn resealed(mut bytes: Vec<u8>) -> Vec<u8> {
    wire::reseal(&mut bytes);
    bytes
}

#[test]
fn every_truncation_is_refused() {
    let bytes = encode(&small(), None, &settings()).expect("encodes").bytes;
    for length in 0..bytes.len() {
        assert!(decode(&bytes[..length], &LIMITS).is_err(), "{length} bytes");
        assert!(inspect(&bytes[..length]).is_err(), "{length} bytes");
    }
}

#[test]
fn every_truncation_of_the_golden_files_is_refused_behind_good_checksums_too() {
    for bytes in super::golden::files() {
        let table = wire::table_end(&bytes).expect("a table");
        for length in 0..bytes.len() {
            let mut cut = bytes[..length].to_vec();
            assert!(decode(&cut, &LIMITS).is_err(), "{length} bytes");
            if length >= table {
                cut[16..24].copy_from_slice(&(length as u64).to_le_bytes());
                let cut = resealed(cut);
                assert!(decode(&cut, &LIMITS).is_err(), "{length} bytes, sealed");
                assert!(inspect(&cut).is_err(), "{length} bytes, sealed");
            }
        }
    }
}

#[test]
fn every_flipped_bit_of_header_and_table_behind_good_checksums_is_an_error_or_the_same_scene() {
    for bytes in tiny_files() {
        let expected = decode(&bytes, &LIMITS).expect("decodes").scene;
        for bit in 0..8 * wire::table_end(&bytes).expect("a table") {
            let mut damaged = bytes.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            // A table that the file has no room for cannot be sealed; it is refused before its checksum.
            if wire::table_end(&damaged).is_some() {
                damaged = resealed(damaged);
            }
            let _ = inspect(&damaged);
            if let Ok(decoded) = decode(&damaged, &LIMITS) {
                assert_eq!(decoded.scene, expected, "bit {bit}");
            }
        }
    }
}

/// A cube full of anchors whose every symbol is the same.
#[test]
fn a_few_bytes_that_stand_for_very_many_anchors_are_refused_unless_asked_for() {
    let mut scene = tiny();
    let edge = 48;
    scene.cells = (0..edge * edge * edge).map(|n| [n % edge, n / edge % edge, n / edge / edge]).collect();
    let anchors = scene.cells.len();
    scene.features = vec![1.0; anchors];
    scene.scalings = vec![0.01; 6 * anchors];
    scene.offsets = vec![0.0; 3 * anchors];
    scene.masks = vec![true; anchors];
    let bytes = encode(&scene, None, &settings()).expect("encodes").bytes;
    assert!(bytes.len() < 4000, "{} bytes", bytes.len());
    let strict = DecodeLimits { max_expansion: 100, ..DecodeLimits::default() };
    assert!(matches!(decode(&bytes, &strict), Err(tcgs_codec::DecodeError::Limit { .. })));
    assert_eq!(decode(&bytes, &DecodeLimits::NONE).expect("decodes").scene.len(), anchors);
}

#[test]
fn every_flipped_bit_is_found() {
    for bytes in tiny_files() {
        for bit in 0..8 * bytes.len() {
            let mut damaged = bytes.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert!(decode(&damaged, &LIMITS).is_err(), "bit {bit}");
        }
    }
}

#[test]
fn every_flipped_bit_behind_good_checksums_is_an_error_or_the_same_scene() {
    for bytes in tiny_files() {
        let expected = decode(&bytes, &LIMITS).expect("decodes").scene;
        let first = wire::HEADER + wire::parts(&bytes).len() * wire::ENTRY;
        for bit in 8 * first..8 * bytes.len() {
            let mut damaged = bytes.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            let damaged = resealed(damaged);
            let _ = inspect(&damaged);
            if let Ok(decoded) = decode(&damaged, &LIMITS) {
                assert_eq!(decoded.scene, expected, "bit {bit}");
            }
        }
    }
}

#[test]
fn sections_cut_short_behind_good_checksums_are_errors_or_the_same_scene() {
    for bytes in tiny_files() {
        let expected = decode(&bytes, &LIMITS).expect("decodes").scene;
        for (section, (id, _, content)) in wire::parts(&bytes).into_iter().enumerate() {
            for length in 0..content.len() {
                let mut parts = wire::parts(&bytes);
                parts[section].2.truncate(length);
                match decode(&wire::file((1, 0), &parts), &LIMITS) {
                    // Other latents or weights, but by chance no other prediction.
                    Ok(decoded) if [*b"CTXT", *b"PLAN"].contains(&id) => assert_eq!(decoded.scene, expected),
                    Ok(_) => panic!("section {section}, {length} bytes"),
                    Err(_) => {}
                }
            }
        }
    }
}

#[test]
fn planes_without_content_are_refused_before_memory_is_taken() {
    // Edge and channels are the section's first varints: claim 512 and 5, which a layer doubles.
    let mut parts = wire::parts(&tiny_context_file());
    let planes = parts.iter_mut().find(|part| part.0 == *b"PLAN").expect("has planes");
    planes.2.splice(0..2, [0x80, 0x04, 0x05]);
    let bytes = wire::file((1, 0), &parts);
    let limits = DecodeLimits { max_memory_bytes: 1 << 20, ..LIMITS };
    assert!(matches!(decode(&bytes, &limits), Err(tcgs_codec::DecodeError::Limit { .. })));
    assert!(decode(&bytes, &DecodeLimits::NONE).is_err());
}

#[test]
fn counts_without_content_are_refused_before_memory_is_taken() {
    // Anchors, Gaussians and the anchors of a chunk are the manifest's first varints: claim four billion.
    let mut parts = wire::parts(&tiny_file());
    let rest = parts[0].2[1..].to_vec();
    let mut manifest = vec![0xff, 0xff, 0xff, 0xff, 0x0f];
    manifest.extend(rest);
    parts[0].2 = manifest;
    let bytes = wire::file((1, 0), &parts);
    assert!(decode(&bytes, &LIMITS).is_err());
    assert!(decode(&bytes, &DecodeLimits::NONE).is_err());
    assert!(inspect(&bytes).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn garbage_is_refused(bytes in prop::collection::vec(any::<u8>(), 0..400), signed: bool) {
        let mut bytes = bytes;
        if signed && bytes.len() >= 12 {
            bytes[..12].copy_from_slice(b"\x89TCGS\r\n\x1a\x01\x00\x00\x00");
        }
        prop_assert!(decode(&bytes, &LIMITS).is_err());
        prop_assert!(inspect(&bytes).is_err());
    }

    #[test]
    fn garbage_sections_behind_good_checksums_are_refused(
        section in 0_usize..7,
        content in prop::collection::vec(any::<u8>(), 0..300),
        at in any::<prop::sample::Index>(),
        splice: bool,
    ) {
        for bytes in tiny_files() {
            let mut parts = wire::parts(&bytes);
            let section = section % parts.len();
            let original = parts[section].2.clone();
            let place = at.index(original.len() + 1);
            parts[section].2 = if splice {
                [&original[..place], &content, &original[place..]].concat()
            } else {
                [&original[..place], &content].concat()
            };
            let damaged = wire::file((1, 0), &parts);
            let _ = inspect(&damaged);
            if let Ok(decoded) = decode(&damaged, &LIMITS) {
                let context = [*b"CTXT", *b"PLAN"].contains(&parts[section].0);
                prop_assert!(context || parts[section].2 == original);
                prop_assert_eq!(decoded.scene, decode(&bytes, &LIMITS)?.scene);
            }
        }
    }
}
