//! `tcgs poses`: photographs without cameras become a dataset, held to cameras that surveyors measured.

use std::{collections::BTreeMap, env, fs, path::Path};

use glam::DVec3;
use serde_json::{Value, json};
use tcgs::{domain::NamedCamera, ingest};

use crate::support::{
    program::{answers, succeeds, tcgs},
    shared::shared,
    skip::skip,
};

fn has_pycolmap() -> bool {
    let named = env::var_os("TCGS_POSES_PYTHON").is_some_and(|path| !path.is_empty());
    if !named {
        skip("TCGS_POSES_PYTHON names no Python with pycolmap: make poses");
    }
    named
}

/// The places of cameras by the names of their photographs, without folder and extension.
fn places(dataset: &Path) -> BTreeMap<String, DVec3> {
    let cameras = ingest::cameras(dataset).expect("cameras");
    let name = |name: &str| Path::new(name).file_stem().expect("a name").to_str().expect("UTF-8").to_owned();
    cameras.iter().map(|NamedCamera { name: path, camera, .. }| (name(path), camera.pose.center())).collect()
}

fn problem(arguments: &[&str]) -> (Option<i32>, Value) {
    let refused = tcgs([arguments, &["--json"]].concat());
    (refused.status.code(), serde_json::from_slice(&refused.stdout).expect("one JSON document"))
}

#[test]
fn cameras_are_found_where_surveyors_measured_them_and_the_dataset_is_one() {
    let Some(scene) = shared("data/fountain_p11") else { return };
    if !has_pycolmap() {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let [photographs, found, zip] =
        ["photographs", "found", "found.zip"].map(|name| folder.path().join(name));
    // In folders of their own, as cameras leave them.
    let images = photographs.join("DCIM/100");
    fs::create_dir_all(&images).expect("a folder");
    let mut names = Vec::new();
    for entry in fs::read_dir(scene.join("images")).expect("photographs") {
        let entry = entry.expect("a photograph");
        fs::copy(entry.path(), images.join(entry.file_name())).expect("copies");
        names.push(entry.file_name());
    }
    let path = |path: &Path| path.to_str().expect("UTF-8").to_owned();
    let report = answers(["poses", &path(&photographs), "-o", &path(&found), "--json"]);
    assert_eq!(report["registered"].as_array().map(Vec::len), Some(names.len()), "{report:#}");
    assert!(report["reprojection_error"].as_f64().expect("pixels") < 1.0, "{report:#}");
    let checked = answers(["check", &path(&found), "--json", "--no-calibration"]);
    assert_eq!((&checked["layout"], &checked["test"]), (&json!("colmap"), &json!(2)));

    // Places are right but for a turn, a shift and a scale: ratios of distances are those of the true places.
    let (truth, ours) = (places(&scene), places(&found));
    let (first, last) = ("0000", "0010");
    let scale = ours[first].distance(ours[last]) / truth[first].distance(truth[last]);
    for (name, place) in &ours {
        for (other, there) in &ours {
            let (ours, truth) = (place.distance(*there) / scale, truth[name].distance(truth[other]));
            assert!((ours - truth).abs() < 0.02 * truth.max(1.0), "{name} to {other}: {ours}, not {truth}");
        }
    }
    // And the scene is upright: -y is up where the cameras' own up is.
    let cameras = ingest::cameras(&found).expect("cameras");
    let up = cameras.iter().map(|camera| -camera.camera.pose.rotation().row(1)).sum::<DVec3>();
    assert!(up.normalize().dot(DVec3::NEG_Y) > 0.99, "{up}");

    // Neighbors alone, on more threads than there is memory for, into a zip.
    let arguments = ["--matching", "sequential", "--threads", "32", "--host-memory", "1GiB"];
    let told = succeeds([&["poses", &path(&photographs), "-o", &path(&zip)][..], &arguments].concat());
    assert!(told.contains("11 of 11") && told.contains("tcgs train"), "{told}");
    assert_eq!(answers(["check", &path(&zip), "--json", "--no-calibration"])["layout"], "colmap");
}

#[test]
fn photographs_that_tell_nothing_and_outputs_that_exist_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let photographs = folder.path().join("photographs");
    fs::create_dir(&photographs).expect("a folder");
    let path = |path: &Path| path.to_str().expect("UTF-8").to_owned();
    let (given, output) = (path(&photographs), path(&folder.path().join("new")));
    let gray = image::GrayImage::from_pixel(64, 48, image::Luma([128]));
    for number in 0..2 {
        gray.save(photographs.join(format!("{number}.png"))).expect("writes");
    }
    let (status, refused) = problem(&["poses", &given, "-o", &output]);
    assert_eq!((status, &refused["type"]), (Some(3), &Value::from("urn:tcgs:problem:too-few-photographs")));
    let (status, refused) = problem(&["poses", &given, "-o", &given]);
    assert_eq!((status, &refused["type"]), (Some(3), &Value::from("urn:tcgs:problem:exists")));
    let (_, refused) = problem(&["check", &given]);
    assert_eq!(refused["type"], "urn:tcgs:problem:too-few-photographs");
    gray.save(photographs.join("2.png")).expect("writes");
    assert_eq!(answers(["check", &given, "--json", "--no-calibration"])["layout"], "photographs");
    let (status, refused) = problem(&["poses", &given, "-o", &output, "--python", "/no/python"]);
    assert_eq!((status, &refused["type"]), (Some(4), &Value::from("urn:tcgs:problem:poses-unavailable")));
    if has_pycolmap() {
        let (status, refused) = problem(&["poses", &given, "-o", &output]);
        assert_eq!(
            (status, &refused["type"]),
            (Some(3), &Value::from("urn:tcgs:problem:featureless-photographs"))
        );
    }
    assert!(!Path::new(&output).exists());
    assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 1, "nothing is left behind");
}

#[cfg(unix)]
#[test]
fn frames_of_a_video_are_photographs_and_a_broken_one_is_refused() {
    use std::{os::unix::fs::PermissionsExt as _, process::Command};

    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    let video = path("walk.mp4");
    if !Command::new("ffmpeg").arg("-version").output().is_ok_and(|output| output.status.success()) {
        skip("there is no ffmpeg: scripts/setup.sh --for-videos");
        return;
    }
    let refused = tcgs(["sample", &video, "--side", "63", "--views", "20"]);
    assert_eq!(refused.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("63x63 pixels have an odd side"));
    let told = succeeds(["sample", &video, "--size", "64x48", "--views", "20"]);
    assert!(told.contains("20 frames"), "{told}");
    // An interpreter that tells the request, and whether its photographs are there.
    let script = r#"#!/bin/sh
        folder=$(sed -n 's/.*"photographs":"\([^"]*\)".*/\1/p' "$3")
        names=$(sed -n 's/.*"names":\[\([^]]*\)\].*/\1/p' "$3" | tr -d '"')
        matching=$(sed -n 's/.*"matching":"\([^"]*\)".*/\1/p' "$3")
        echo "{\"failure\": \"no-overlap\", \"detail\": \"$matching of $names; $(ls "$folder" | wc -l) files\"}"
    "#;
    let python = path("python");
    fs::write(&python, script).expect("a script");
    fs::set_permissions(&python, fs::Permissions::from_mode(0o755)).expect("executable");
    let search =
        |video: &str| problem(&["poses", video, "-o", &path("new"), "--frames", "3", "--python", &python]).1;
    let told = search(&video);
    let detail = told["detail"].as_str().expect("a detail");
    let frames = "frame_00001.jpg,frame_00002.jpg,frame_00003.jpg";
    assert!(detail.starts_with(&format!("sequential of {frames}; 3 files")), "{told:#}");
    assert_eq!(answers(["check", &video, "--json", "--no-calibration"])["layout"], "video");

    let broken = path("broken.mov");
    fs::write(&broken, b"\0\0\0\x14ftypqt  \0\0\0\0qt  and nothing more").expect("written");
    assert_eq!(search(&broken)["type"], "urn:tcgs:problem:video-rejected");
    assert!(!Path::new(&path("new")).exists());
}
