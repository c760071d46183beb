//! docs/HARDWARE.md has a place for the tables of `scripts/hardware.py`, and outputs of `scripts/gpu_day.sh` become those tables.

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use serde_json::{Value, json};

use crate::support::{
    skip::skip,
    tree::{root, text},
};

/// Outputs of commands as excerpts of a run on an H100, and the tables that they give.
const RECORDS: &str = "tests/hardware";

const MARKERS: [&str; 2] = ["<!-- hardware: begin -->", "<!-- hardware: end -->"];

/// Runs a script of `scripts/`; `None` without Python.
fn script(name: &str, arguments: &[&Path]) -> Option<Output> {
    let mut command = Command::new("python3");
    command.arg(root().join("scripts").join(name)).args(arguments);
    command.env("GPU_DAY_STARTED", "2026-11-27T00:32:00Z").env("GPU_DAY_REVISION", "4710d84");
    command.env("GPU_DAY_SECONDS", "540").env("PYTHONDONTWRITEBYTECODE", "1");
    command.output().ok()
}

/// What `gpu_day.py` makes of the records, with its exit status; `None` without Python.
fn collected(folder: &Path) -> Option<(Value, Option<i32>)> {
    let path = folder.join("gpu_day.json");
    let output = script("gpu_day.py", &[&root().join(RECORDS), &path])?;
    let document = fs::read(&path).unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&output.stderr)));
    Some((serde_json::from_slice(&document).expect("JSON"), output.status.code()))
}

#[test]
fn outputs_of_a_gpu_day_become_tables() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some((mut run, _)) = collected(folder.path()) else {
        return skip("python3 is not installed");
    };
    run["machine"]["processor"] = json!("a processor");
    run["machine"]["cores"] = json!(16);
    let (source, document) = (folder.path().join("run.json"), folder.path().join("document.md"));
    fs::write(&source, run.to_string()).expect("writes");
    let [begin, end] = MARKERS;
    fs::write(&document, format!("before\n{begin}\nold\n{end}\nafter\n")).expect("writes");
    let output = script("hardware.py", &[Path::new("--document"), &document, &source]).expect("starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let tables = text(&format!("{RECORDS}/tables.md"));
    let expected = format!("before\n{begin}\n\n{tables}\n{end}\nafter\n");
    assert_eq!(fs::read_to_string(&document).expect("a file"), expected);
}

#[test]
fn a_gpu_day_keeps_figures_and_failures_of_each_command() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some((run, status)) = collected(folder.path()) else {
        return skip("python3 is not installed");
    };
    assert_eq!(status, Some(1), "the record of the tests has a failure");
    assert_eq!(run["machine"]["adapter"], "NVIDIA H100 80GB HBM3");
    assert_eq!(run["machine"]["driver"], "NVIDIA 580.159.04");
    let named = |name: &str| {
        let runs = run["runs"].as_array().expect("runs");
        runs.iter().find(|run| run["name"] == name).unwrap_or_else(|| panic!("no {name}")).clone()
    };
    let kernels = named("kernels");
    let kernels = &kernels["figures"]["sizes"][1];
    assert_eq!(
        kernels["plain_step"],
        json!({"wall_ms": 5.96, "steps_per_second": 167.8, "device_ms": 5.7, "host_ms": 0.16})
    );
    assert_eq!(kernels["kernels"]["plain step"]["raster_backward"], 2.114);
    assert_eq!(named("context")["figures"]["sizes"][0]["kinds"][1]["kernels"]["conv_down"], 0.05);
    assert_eq!(named("chair_800-tcgs")["figures"]["bytes"]["total"], 328_154);
    assert_eq!(named("tests")["figures"]["failed_tests"], json!(["render::raster::image"]));
    assert_eq!(named("chair-3dgs")["status"], "stopped at its limit");
    assert_eq!(named("chair_800-scaffold")["status"], "left out");
}

#[test]
fn the_document_has_a_place_for_the_tables() {
    let document = text("docs/HARDWARE.md");
    let at = MARKERS.map(|marker| document.find(&format!("\n{marker}\n")));
    assert!(at[0].is_some() && at[0] < at[1], "{MARKERS:?} at {at:?}");
}

#[test]
fn the_document_names_every_part_of_the_script() {
    let script = text("scripts/gpu_day.sh");
    let parts = script.lines().find_map(|line| line.strip_prefix("parts=(")?.strip_suffix(')'));
    let document = text("docs/HARDWARE.md");
    let missing: Vec<&str> =
        parts.expect("a list").split(' ').filter(|part| !document.contains(&format!("`{part}`"))).collect();
    assert!(missing.is_empty(), "{missing:?}");
}
