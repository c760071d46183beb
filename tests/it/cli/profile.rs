//! `train --profile`: figures of every stage, and the same file.

use std::{ffi::OsStr, fs};

use tcgs::sample::{self, Settings};

use crate::support::program::answers;

#[test]
fn a_profile_shows_every_stage_of_a_step_and_leaves_the_file_as_it_was() {
    let folder = tempfile::tempdir().expect("a folder");
    let dataset = folder.path().join("scene");
    sample::write(&dataset, &Settings { points: 300, ..Settings::square(32) }).expect("writes");
    let train = |name: &str, flags: &[&str]| {
        let file = folder.path().join(name);
        let mut line: Vec<&OsStr> = vec!["train".as_ref(), dataset.as_ref(), "-o".as_ref(), file.as_ref()];
        line.extend(["--iterations", "20", "--json"].iter().chain(flags).map(OsStr::new));
        (answers(line), fs::read(&file).expect("a file"))
    };
    let (metrics, plain) = train("plain.tcgs", &[]);
    assert!(metrics.get("profile").is_none());
    let (metrics, profiled) = train("profiled.tcgs", &["--profile"]);
    assert_eq!(profiled, plain);

    let rows = metrics["profile"].as_array().expect("rows");
    let stages: Vec<&str> = rows
        .iter()
        .filter(|row| row["recording"] == "step" && row["kernel"].is_null())
        .map(|row| row["stage"].as_str().expect("a name"))
        .collect();
    let expected = ["model forward", "rasterizer forward", "loss", "rasterizer backward", "model backward"];
    for stage in expected.iter().chain(&["context model", "masks", "optimizer", "submit", "wait"]) {
        assert!(stages.contains(stage), "{stage}: {stages:?}");
    }
    let blending = rows.iter().find(|row| row["kernel"] == "raster_forward").expect("a row of the kernel");
    assert_eq!(blending["count"], 1.0);
    assert!(blending["device_ms"].as_f64().expect("timestamps on lavapipe") > 0.0);
}
