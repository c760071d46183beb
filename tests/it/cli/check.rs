//! `tcgs check`: what a dataset holds, or why it cannot be trained on.

use std::fs;

use serde_json::{Value, json};
use tcgs::sample;

use crate::support::program::{answers, succeeds, tcgs};

#[test]
fn a_dataset_is_described_or_refused_with_the_file_that_is_wrong() {
    let folder = tempfile::tempdir().expect("a folder");
    let (scene, zip) = (folder.path().join("scene"), folder.path().join("scene.zip"));
    let settings = sample::Settings { points: 50, ..sample::Settings::square(16) };
    for place in [&scene, &zip] {
        sample::write(place, &settings).expect("writes");
    }
    let path = scene.to_str().expect("UTF-8");
    let told = succeeds(["check", path, "--no-calibration"]);
    for line in [
        "layout       nerfstudio",
        "photographs  40 to train on, 8 held out",
        "size         16x16 pixels",
        "points       50",
        "schedule     preview of tcgs, 32 features and 4 offsets an anchor, weight of the rate 0.0005, 50 steps a photograph",
        "training     2000 steps",
        "memory       up to ",
        "file         ",
    ] {
        assert!(told.contains(line), "{line}: {told}");
    }
    let described = |arguments: &[&str]| {
        let mut document = answers([&["check", "--json", "--no-calibration"], arguments].concat());
        let estimate = document.as_object_mut().expect("an object").remove("estimate").expect("an estimate");
        (document, estimate)
    };
    let (document, estimate) = described(&[path]);
    let expected = json!({ "layout": "nerfstudio", "train": 40, "test": 8, "pixels": 48 * 256, "points": 50,
        "notes": [], "smallest": [16, 16], "largest": [16, 16] });
    assert_eq!(document, expected);
    assert_eq!(described(&[zip.to_str().expect("UTF-8")]), (expected, estimate));

    let (sector, _) = described(&[path, "--holdout", "sector"]);
    assert_eq!((&sector["train"], &sector["test"]), (&json!(42), &json!(6)));
    let note =
        "a sector is held out: the 6 photographs whose cameras are nearest to that of images/view_00.png";
    assert_eq!(sector["notes"], json!([note]));

    fs::remove_file(scene.join("images/view_07.png")).expect("removes");
    let refused = tcgs(["check", path, "--json"]);
    assert_eq!(refused.status.code(), Some(3));
    let problem: Value = serde_json::from_slice(&refused.stdout).expect("one JSON document");
    assert_eq!(problem["type"], "urn:tcgs:problem:dataset-rejected", "{problem:#}");
    assert!(problem.to_string().contains("view_07.png"), "{problem:#}");
    assert!(problem.to_string().contains("--skip-missing"), "the way out is named: {problem:#}");
    let (without, _) = described(&[path, "--skip-missing"]);
    assert_eq!(without["train"].as_u64().zip(without["test"].as_u64()).map(|(a, b)| a + b), Some(47));
    let note = "1 of the 48 photographs of transforms.json are missing and left out: images/view_07.png";
    assert_eq!(without["notes"], json!([note]));
    assert_eq!(
        tcgs(["check", folder.path().join("missing").to_str().expect("UTF-8")]).status.code(),
        Some(3)
    );
}

#[test]
fn a_job_is_estimated_by_its_first_steps_and_what_is_unknown_is_noted() {
    let folder = tempfile::tempdir().expect("a folder");
    sample::write(folder.path(), &sample::Settings { points: 50, ..sample::Settings::square(16) })
        .expect("writes");
    let path = folder.path().to_str().expect("UTF-8");
    let estimate = |flags: &[&str]| answers([&["check", path, "--json"], flags].concat())["estimate"].clone();

    // A run so short that it ends before the clock does.
    let known = estimate(&["--iterations", "12"]);
    let number = |value: &Value| value.as_f64().expect("a number");
    assert_eq!((&known["steps"], &known["calibration"]["steps"]), (&json!(12), &json!(11)), "{known:#}");
    let speed = number(&known["calibration"]["steps_per_second"]);
    let [low, high] = ["low", "high"].map(|end| number(&known["train_seconds"][end]));
    assert!(low <= 12.0 / speed && 12.0 / speed <= high && low < high, "{known:#}");
    assert_eq!(known["notes"], json!([]));
    assert_eq!((&known["memory"]["unit"], &known["memory"]["max_size"]), (&json!("anchors"), &json!(40_000)));

    let off = estimate(&["--no-calibration", "--preset", "standard", "--max-bytes", "90kB"]);
    assert_eq!((&off["train_seconds"], &off["calibration"]), (&Value::Null, &Value::Null));
    assert_eq!(off["notes"], json!(["training time is unknown without a calibration"]));
    assert_eq!((&off["steps"], &off["file_bytes"]["high"]), (&json!(10_000), &json!(90_000)));
    let chosen = json!({ "preset": "standard", "model": "tcgs", "features": 50, "offsets": 10, "lambda": 0.0005,
        "steps_per_photograph": 250.0 });
    assert_eq!(off["schedule"], chosen);

    let none = estimate(&["--adapter", "no such adapter"]);
    assert_eq!((&none["memory"], &none["train_seconds"]), (&Value::Null, &Value::Null));
    let note = none["notes"][0].as_str().expect("a note");
    assert!(note.starts_with("time and memory are unknown: ") && note.contains("no such adapter"), "{note}");
    assert_eq!(none["notes"].as_array().map(Vec::len), Some(1));
    let small = estimate(&["--no-calibration", "--gpu-memory", "1MiB"]);
    assert_eq!(small["memory"], Value::Null);
    assert!(small["notes"][0].as_str().is_some_and(|note| note.contains("--gpu-memory")), "{small:#}");
    assert_eq!(tcgs(["check", path, "--iterations", "0"]).status.code(), Some(2));
}
