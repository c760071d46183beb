//! `tcgs bench views`: its document, its table, and what it refuses.

use crate::support::program::{answers, succeeds, tcgs};

const SCENE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/trained_v1.tcgs");

const POSE: &str = r#"{"camera_to_world": [[1,0,0,0],[0,-1,0,0],[0,0,-1,4],[0,0,0,1]],
    "fx": 60, "width": 60, "height": 40}"#;

#[test]
fn every_size_has_three_rates_and_more_work_is_not_faster() {
    let arguments = ["bench", "views", SCENE, "--pose", POSE, "--seconds", "0.1", "--sizes", "64x48,333x222"];
    let document = answers(arguments.into_iter().chain(["--json"]));
    assert!(document["adapter"].as_str().is_some_and(|adapter| !adapter.is_empty()));
    let sizes = document["sizes"].as_array().expect("a list");
    let sides: Vec<_> = sizes.iter().map(|size| (size["width"].as_u64(), size["height"].as_u64())).collect();
    assert_eq!(sides, [(Some(64), Some(48)), (Some(333), Some(222))]);
    for size in sizes {
        for rate in ["device", "image", "jpeg"] {
            assert!(size[rate].as_f64().is_some_and(|rate| rate > 0.0), "{size}");
        }
    }
    let table = succeeds(arguments);
    assert!(table.contains("frames/s") && table.contains("333x222"), "{table}");
}

#[test]
fn what_is_not_a_size_a_time_or_a_camera_is_refused() {
    for (flags, word) in [
        (vec!["--pose", POSE, "--sizes", "0x4"], "1920x1080"),
        (vec!["--pose", POSE, "--seconds", "0"], "above 0"),
        (vec!["--frame", "a"], "--dataset"),
        (vec![], "--pose"),
    ] {
        let output = tcgs(["bench", "views", SCENE].into_iter().chain(flags));
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains(word), "{said}");
    }
}
