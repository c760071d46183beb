//! What an inspection says of a file: every byte's purpose, the choices of its run, and both as a text.

use tcgs_codec::{
    DecodeLimits, EncodeSettings, Provenance, decode,
    domain::choices::{Choices, SizeBound, Widths},
    encode, inspect, stored_steps,
};

use super::{
    golden,
    synthetic::{settings, tiny},
};

#[test]
fn every_byte_of_the_golden_files_has_a_purpose() {
    for bytes in golden::files() {
        let ranges = inspect(&bytes).expect("inspects").ranges;
        for range in ranges {
            assert!(!range.what.contains("later version"), "{range:?}");
            // A chunk's symbols may all be certain.
            assert!(range.length > 0 || range.what.starts_with("chunk"), "{range:?}");
        }
    }
}

/// Of `shell_v1.tcgs`, which never changes.
#[test]
fn the_text_has_counts_choices_shares_and_places() {
    let text = inspect(&golden::files()[0]).expect("inspects").to_string();
    for line in [
        ".tcgs version 1.0, arithmetic profile 1, 6314 bytes",
        "gaussians          1025",
        "scaling step       0.0005 (0.050000004 voxel)",
        "adapter            an adapter",
        "offsets per anchor       4                                        \
         as published; masks keep 1025 of 1596, 2.57 an anchor",
        "container            384   6.08%         0.962",
        "scalings            1872  29.65%         4.692",
        "total               6314 100.00%        15.825",
        "scalings     tables                   1872              -              -              -              -",
        "ATTR     attributes       yes       1808       4506",
        "       200        174  container  manifest: counts, lattice, steps, contexts, provenance",
        "      4627       1687  offsets    chunk 0, anchors 0..399",
    ] {
        assert!(text.lines().any(|other| other == line), "no line {line}\n{text}");
    }
}

#[test]
fn choices_are_explained_from_the_provenance() {
    let choices = Choices {
        max_anchors: 40_000,
        max_anchors_by: SizeBound::Preset,
        points: 5000,
        random_points: false,
        exposure: None,
        narrowed_from: Some(Widths { features: 32, offsets: 10 }),
    };
    let provenance = Provenance {
        settings: serde_json::json!({ "voxel": "published", "choices": choices }),
        ..settings().provenance
    };
    let encoded = encode(&tiny(), None, &EncodeSettings { provenance, ..settings() }).expect("encodes");
    let explained = inspect(&encoded.bytes).expect("inspects").choices;
    for (what, value, because) in [
        ("voxel", "0.01", "the published rule, over 5000 points"),
        ("anchors at most", "40000", "the preset's number fits"),
        ("feature width", "1", "of 32 learnt"),
        ("offsets per anchor", "1", "the slots of 10 that an anchor uses; masks keep 3 of 3, 1.00 an anchor"),
    ] {
        let choice = explained.iter().find(|choice| choice.what == what).expect("is explained");
        assert_eq!(choice.value, value, "{choice:?}");
        assert!(choice.because.starts_with(because), "{choice:?}");
    }
}

#[test]
fn values_are_integers_times_the_stored_steps() {
    for bytes in golden::files() {
        let scene = decode(&bytes, &DecodeLimits::NONE).expect("decodes").scene;
        let stored = stored_steps(&bytes, &DecodeLimits::NONE).expect("reads");
        assert_eq!(stored.cells, scene.cells);
        let attributes = [&scene.features, &scene.scalings, &scene.offsets];
        for (values, steps) in attributes.into_iter().zip(&stored.steps) {
            assert_eq!(steps.len(), scene.len());
            for (row, step) in values.chunks(values.len() / scene.len()).zip(steps) {
                assert!(row.iter().all(|value| (value / step).round_ties_even() * step == *value));
            }
        }
    }
}
