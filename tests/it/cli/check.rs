//! `tcgs check`: what a dataset holds, or why it cannot be trained on.

use std::fs;

use serde_json::{Value, json};
use tcgs::sample;

use crate::support::program::{answers, succeeds, tcgs};

#[test]
fn a_dataset_is_described_or_refused_with_the_file_that_is_wrong() {
    let folder = tempfile::tempdir().expect("a folder");
    let (scene, zip) = (folder.path().join("scene"), folder.path().join("scene.zip"));
    let settings = sample::Settings { side: 16, points: 50, seed: 1 };
    for place in [&scene, &zip] {
        sample::write(place, &settings).expect("writes");
    }
    let path = scene.to_str().expect("UTF-8");
    let told = succeeds(["check", path]);
    for line in [
        "layout       nerfstudio",
        "photographs  40 to train on, 8 held out",
        "size         16x16 pixels",
        "points       50",
    ] {
        assert!(told.contains(line), "{line}: {told}");
    }
    let document = answers(["check", path, "--json"]);
    let expected = json!({ "layout": "nerfstudio", "train": 40, "test": 8, "pixels": 48 * 256, "points": 50,
        "notes": [], "smallest": [16, 16], "largest": [16, 16] });
    assert_eq!(document, expected);
    assert_eq!(answers(["check", zip.to_str().expect("UTF-8"), "--json"]), expected);

    fs::remove_file(scene.join("images/view_07.png")).expect("removes");
    let refused = tcgs(["check", path, "--json"]);
    assert_eq!(refused.status.code(), Some(3));
    let problem: Value = serde_json::from_slice(&refused.stdout).expect("one JSON document");
    assert_eq!(problem["type"], "urn:tcgs:problem:dataset-rejected", "{problem:#}");
    assert!(problem.to_string().contains("view_07.png"), "{problem:#}");
    assert!(problem.to_string().contains("--skip-missing"), "the way out is named: {problem:#}");
    let without = answers(["check", path, "--json", "--skip-missing"]);
    assert_eq!(without["train"].as_u64().zip(without["test"].as_u64()).map(|(a, b)| a + b), Some(47));
    let note = "1 of the 48 photographs of transforms.json are missing and left out: images/view_07.png";
    assert_eq!(without["notes"], json!([note]));
    assert_eq!(
        tcgs(["check", folder.path().join("missing").to_str().expect("UTF-8")]).status.code(),
        Some(3)
    );
}
