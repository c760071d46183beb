//! `make gate` holds what fixed runs give to committed values, and says what moved. Here with a program that only pretends to train.

use std::{fs, os::unix::fs::PermissionsExt as _, path::Path, process::Command};

use crate::support::{skip::skip, tree::root};

/// A program that writes no file and reports these figures.
fn program(folder: &Path, psnr: f64, bytes: u64, seconds: f64) {
    let metrics = format!(
        r#"{{"test":{{"psnr":{psnr}}},"bytes":{{"total":{bytes}}},"seconds":{{"train":{seconds}}},"adapter":"none"}}"#
    );
    let path = folder.join("tcgs");
    fs::write(&path, format!("#!/bin/sh\n[ \"$1\" = sample ] || echo '{metrics}'\n")).expect("writes");
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("a program");
}

/// Exit status and output of the gate with that program.
fn gate(folder: &Path, flags: &[&str], ci: bool) -> Option<(Option<i32>, String)> {
    let mut command = Command::new("python3");
    command.arg(root().join("scripts/gate.py")).args(["--yardstick", "2", "--adapter", "lavapipe"]);
    command.arg("--committed").arg(folder.join("gate.json")).args(flags);
    command.env("TCGS", folder.join("tcgs")).env("TCGS_SHARED", folder);
    command.env("CI", if ci { "true" } else { "" });
    let output = command.output().ok()?;
    let text = [output.stdout, output.stderr].concat();
    Some((output.status.code(), String::from_utf8_lossy(&text).into_owned()))
}

#[test]
fn the_gate_opens_within_its_bounds_and_names_what_moved_beyond_them() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    program(folder, 28.0, 100_000, 30.0);
    let Some((status, text)) = gate(folder, &[], false) else { return skip("python3 is not installed") };
    assert!(status == Some(1) && text.contains("--update"), "there are no values yet: {text}");
    let run = |flags: &[&str], ci: bool| gate(folder, flags, ci).expect("python3 ran before");

    let (status, text) = run(&["--update"], false);
    assert!(status == Some(1) && text.contains("plush"), "values of all scenes or none: {text}");
    fs::create_dir_all(folder.join("data/plush")).expect("a folder");
    assert_eq!(run(&["--update"], false).0, Some(0));
    for (psnr, bytes, seconds) in [(28.0, 100_000, 30.0), (27.81, 102_900, 110.0), (28.19, 97_100, 8.0)] {
        program(folder, psnr, bytes, seconds);
        let (status, text) = run(&[], true);
        assert!(status == Some(0) && !text.contains("MOVED"), "{text}");
    }
    for (psnr, bytes, seconds, moved) in [
        (27.79, 100_000, 30.0, "PSNR"),
        (28.21, 100_000, 30.0, "PSNR"),
        (28.0, 103_100, 30.0, "bytes"),
        (28.0, 96_900, 30.0, "bytes"),
        (28.0, 100_000, 130.0, "yardstick"),
        (28.0, 100_000, 7.0, "yardstick"),
    ] {
        program(folder, psnr, bytes, seconds);
        let (status, text) = run(&[], true);
        assert!(status == Some(1), "{text}");
        assert!(text.contains("gate: bundled/tcgs: ") && text.contains(moved), "{text}");
        assert!(text.contains("make gate UPDATE=1"), "{text}");
    }

    program(folder, 28.0, 100_000, 30.0);
    fs::remove_dir_all(folder.join("data")).expect("removed");
    let (status, text) = run(&[], false);
    assert!(status == Some(0) && text.contains("SKIPPED"), "{text}");
    let (status, text) = run(&[], true);
    assert!(status == Some(1) && text.contains("CI does not accept"), "{text}");
}

#[test]
fn values_are_committed_for_the_adapter_of_ci() {
    let text = fs::read_to_string(root().join("scripts/gate.json")).expect("scripts/gate.json");
    let values: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let runs = values["lavapipe"]["runs"].as_object().expect("runs");
    for name in ["bundled/tcgs", "plush/tcgs"] {
        assert!(runs[name]["psnr"].as_f64().is_some_and(|psnr| psnr > 10.0), "{name}: {runs:?}");
    }
}
