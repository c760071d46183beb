//! `tcgs bench contexts`: its document, its table, and what it refuses.

use crate::support::program::{answers, succeeds, tcgs};

const SCENE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/trained_v1.tcgs");

#[test]
fn every_context_codes_every_part_and_the_choice_is_the_smallest() {
    let document = answers(["bench", "contexts", SCENE, "--anchors", "0,64", "--steps", "3", "--json"]);
    let parts = document["parts"].as_array().expect("a list");
    assert_eq!(parts.len(), 2);
    assert_eq!(parts[1]["anchors"], 64);
    assert!(parts[0]["anchors"].as_u64() > Some(64), "0 are all");
    for part in parts {
        let trials = part["trials"].as_array().expect("a list");
        let total = |trial: &serde_json::Value| trial["bytes"]["total"].as_u64().expect("bytes");
        let (chosen, forced) = trials.split_last().expect("trials");
        assert_eq!(forced.len(), 6, "tables, position, three planes, neighbors");
        assert!(
            chosen["context"].as_str().is_some_and(|context| context.starts_with("the encoder's choice"))
        );
        // A few bytes beside: what was compared stands in the manifest.
        let least = forced.iter().map(total).min().expect("files");
        assert!(total(chosen) <= least + 16, "{} of {least}", total(chosen));
        let planes = |trial: &serde_json::Value| trial["bytes"]["planes"].as_u64().expect("bytes");
        assert_eq!((planes(&forced[0]), planes(&forced[1])), (0, 0));
        assert!(planes(&forced[2]) > 0 && planes(&forced[4]) > planes(&forced[3]));
        for part in ["positions", "masks"] {
            assert!(forced.iter().all(|trial| trial["bytes"][part] == chosen["bytes"][part]), "{part}");
        }
    }
    let table = succeeds(["bench", "contexts", SCENE, "--anchors", "64", "--steps", "1"]);
    assert!(table.contains("64 anchors") && table.contains("planes of 64, neighbors"), "{table}");
}

#[test]
fn several_scenes_lie_side_by_side() {
    let document = answers(["bench", "contexts", SCENE, SCENE, "--anchors", "50", "--steps", "1", "--json"]);
    assert_eq!(document["parts"][0]["anchors"], 50);
}

#[test]
fn what_is_no_scene_of_anchors_or_no_number_is_refused() {
    let output = tcgs(["bench", "contexts", SCENE, "--steps", "0"]);
    assert_eq!(output.status.code(), Some(2));
    let output = tcgs(["bench", "contexts", concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml")]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && said.contains("Cargo.toml"), "{said}");
}
