//! The baselines' own kinds of file: trained by the program, inspected, measured, shown and coded by it.

use std::{ffi::OsStr, path::Path};

use serde_json::Value;
use tcgs::{
    domain::{Digest, SceneFormat},
    export::anchors,
    sample::{self, Settings},
};

use crate::support::{
    program::{answers, succeeds, tcgs},
    server::picture,
};

/// Arguments of several types as one line.
macro_rules! line {
    ($($argument:expr),+ $(,)?) => { vec![$(AsRef::<OsStr>::as_ref(&$argument)),+] };
}

fn parts(bytes: &Value) -> u64 {
    let bytes = bytes.as_object().expect("byte counts");
    bytes.iter().filter(|(name, _)| *name != "total").map(|(_, n)| n.as_u64().expect("a count")).sum()
}

/// What `tcgs inspect` and `tcgs eval` say of a file has to be what training said of it.
fn check_file(file: &Path, dataset: &Path, metrics: &Value) {
    let written = std::fs::read(file).expect("a file");
    assert_eq!(metrics["bytes"]["total"], written.len());
    assert_eq!(parts(&metrics["bytes"]), written.len() as u64, "the parts add up");
    let before = &metrics["psnr_before_quantisation"];
    assert_eq!(metrics["test"]["psnr"], *before, "nothing was quantized");

    let account = answers(line!["inspect", file, "--json"]);
    assert_eq!(account["byte_counts"], metrics["bytes"]);
    let measured = answers(line!["eval", file, dataset, "--json"]);
    for figure in ["test", "bytes", "anchors", "gaussians", "decode_sha256", "background"] {
        assert_eq!(measured[figure], metrics[figure], "{figure}");
    }

    let out = file.with_extension("png");
    succeeds(line!["render", file, "--dataset", dataset, "--frame", "view_06", "-o", out]);
    let seen = picture(&std::fs::read(&out).expect("a picture"));
    let colors: std::collections::BTreeSet<&[u8]> = seen.as_bytes().chunks(3).collect();
    assert!(colors.len() > 50, "a picture of something");
}

#[test]
fn scaffold_is_written_as_floats_and_every_command_takes_its_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let (dataset, file) = (folder.path().join("scene"), folder.path().join("out.safetensors"));
    sample::write(&dataset, &Settings { points: 300, ..Settings::square(32) }).expect("writes");
    let metrics = answers(line![
        "train",
        dataset,
        "-o",
        file,
        "--model",
        "scaffold",
        "--iterations",
        "20",
        "--background",
        "white",
        "--json"
    ]);
    check_file(&file, &dataset, &metrics);

    let bytes = std::fs::read(&file).expect("a file");
    assert_eq!(SceneFormat::of_bytes(&bytes), SceneFormat::Safetensors);
    let read = anchors::read(&bytes).expect("anchors");
    assert!(read.dataset.is_some(), "the file says what it was trained on");
    assert_eq!(metrics["anchors"], read.scene.len());
    let offsets = read.scene.offsets_per_anchor;
    assert_eq!(metrics["gaussians"], offsets * read.scene.len(), "every offset is kept, as published");
    assert_eq!(metrics["bytes"]["masks"], 0);

    let again = folder.path().join("again.safetensors");
    let decoded = answers(line!["decode", file, "-o", again, "--json"]);
    assert_eq!(decoded["decode_sha256"], metrics["decode_sha256"]);
    assert_eq!(Digest::of(&std::fs::read(&again).expect("a file")), Digest::of(&bytes), "already decoded");

    let coded = folder.path().join("coded.tcgs");
    succeeds(line!["encode", file, "-o", coded]);
    let small = std::fs::metadata(&coded).expect("a file").len();
    assert!(small * 4 < bytes.len() as u64, "{small} of {} bytes", bytes.len());
    let measured = answers(line!["eval", coded, dataset, "--json"]);
    assert_eq!(measured["same_dataset"], true, "where it comes from is kept");
    assert_eq!(measured["background"], "white");
}

#[test]
fn plain_gaussians_are_written_as_ply_and_every_command_takes_their_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let (dataset, file) = (folder.path().join("scene"), folder.path().join("out.ply"));
    sample::write(&dataset, &Settings { points: 300, ..Settings::square(32) }).expect("writes");
    let metrics = answers(line![
        "train",
        dataset,
        "-o",
        file,
        "--model",
        "3dgs",
        "--iterations",
        "90",
        "--background",
        "white",
        "--json"
    ]);
    check_file(&file, &dataset, &metrics);
    assert_eq!(metrics["anchors"], 0);
    assert_eq!(metrics["background"], "white");
    let bytes = std::fs::read(&file).expect("a file");
    assert_eq!(SceneFormat::of_bytes(&bytes), SceneFormat::Ply);
    let gaussians = metrics["gaussians"].as_u64().expect("a count");
    assert_eq!(metrics["bytes"]["positions"], 12 * gaussians);
    assert_eq!(metrics["bytes"]["features"], 4 * 49 * gaussians);
    assert_eq!(answers(line!["eval", file, dataset, "--json"])["same_dataset"], true);

    let out = folder.path().join("out.safetensors");
    let refused = tcgs(line!["decode", file, "-o", out]);
    assert_eq!(refused.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("no anchors"));
}

#[test]
fn a_file_that_is_cut_off_is_refused_by_every_command() {
    let folder = tempfile::tempdir().expect("a folder");
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/shell_v1.tcgs");
    let whole = folder.path().join("whole.safetensors");
    succeeds(line!["decode", golden, "-o", whole]);
    let cut = folder.path().join("cut.safetensors");
    let [tensors, file] = ["out.safetensors", "out.tcgs"].map(|name| folder.path().join(name));
    let bytes = std::fs::read(&whole).expect("a file");
    std::fs::write(&cut, &bytes[..bytes.len() - 7]).expect("writes");
    for arguments in [
        line!["inspect", cut],
        line!["decode", cut, "-o", tensors],
        line!["encode", cut, "-o", file],
        line!["eval", cut, folder.path()],
    ] {
        let refused = tcgs(&arguments);
        assert_eq!(refused.status.code(), Some(3), "{arguments:?}");
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(said.contains("cut.safetensors"), "{said}");
    }
    assert!(!tensors.exists() && !file.exists());
}
