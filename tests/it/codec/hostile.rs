//! Bytes from an enemy: an error or the same scene, never a panic, a hang or a large allocation.

use proptest::prelude::*;
use tcgs::codec::{DecodeLimits, decode, encode, inspect};

use super::{
    synthetic::{settings, small, tiny},
    wire,
};

const LIMITS: DecodeLimits =
    DecodeLimits { max_file_bytes: 1 << 20, max_anchors: 100_000, max_memory_bytes: 64 << 20 };

fn tiny_file() -> Vec<u8> {
    encode(&tiny(), None, &settings()).expect("encodes").bytes
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
fn every_flipped_bit_is_found() {
    let bytes = tiny_file();
    for bit in 0..8 * bytes.len() {
        let mut damaged = bytes.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        assert!(decode(&damaged, &LIMITS).is_err(), "bit {bit}");
    }
}

#[test]
fn every_flipped_bit_behind_good_checksums_is_an_error_or_the_same_scene() {
    let bytes = tiny_file();
    let expected = decode(&bytes, &LIMITS).expect("decodes").scene;
    let first = wire::HEADER + 5 * wire::ENTRY;
    for bit in 8 * first..8 * bytes.len() {
        let mut damaged = bytes.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        if let Ok(decoded) = decode(&resealed(damaged), &LIMITS) {
            assert_eq!(decoded.scene, expected, "bit {bit}");
        }
    }
}

#[test]
fn sections_cut_short_behind_good_checksums_are_errors() {
    let bytes = tiny_file();
    for section in 0..5 {
        let content = wire::parts(&bytes)[section].2.clone();
        for length in 0..content.len() {
            let mut parts = wire::parts(&bytes);
            parts[section].2.truncate(length);
            assert!(
                decode(&wire::file((1, 0), &parts), &LIMITS).is_err(),
                "section {section}, {length} bytes"
            );
        }
    }
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
        section in 0_usize..5,
        content in prop::collection::vec(any::<u8>(), 0..300),
        at in any::<prop::sample::Index>(),
        splice: bool,
    ) {
        let mut parts = wire::parts(&tiny_file());
        let original = parts[section].2.clone();
        let place = at.index(original.len() + 1);
        parts[section].2 = if splice {
            [&original[..place], &content, &original[place..]].concat()
        } else {
            [&original[..place], &content].concat()
        };
        let bytes = wire::file((1, 0), &parts);
        let _ = inspect(&bytes);
        if let Ok(decoded) = decode(&bytes, &LIMITS) {
            prop_assert_eq!(&parts[section].2, &original);
            prop_assert_eq!(decoded.scene.len(), 3);
        }
    }
}
