//! From a file to a view's Gaussians, compared with `tests/oracles/gaussians.py`, which was written from `FORMAT.md` and has its own
//! decoder. Here the twin is compared with it; other tests compare the device with the twin.

use std::process::Command;

use glam::DVec3;
use tcgs_codec::{
    DecodeLimits, decode,
    domain::{Camera, Intrinsics, Pose},
};
use tcgs_render::{
    model::{AnchorRows, NetworkLayout},
    twin::neural as twin,
};

use super::scene::projection;
use crate::support::{skip::skip, tree::root};

/// Rows keep scalings as logarithms in f32, which costs some 1e-6 of them.
const BOUND: f64 = 1e-5;

#[test]
fn a_trained_file_has_the_gaussians_that_its_format_says() {
    let eye = DVec3::new(2.75, -2.25, 1.75);
    assert_has_the_gaussians_of_its_format("trained_v1.tcgs", eye, DVec3::new(0.12, 0.1, 0.32), [300, 500]);
}

#[test]
fn networks_that_get_harmonics_of_the_direction_make_the_gaussians_that_their_format_says() {
    let eye = DVec3::new(0.5, -1.0, 2.25);
    assert_has_the_gaussians_of_its_format("harmonics_v1.tcgs", eye, DVec3::new(0.2, -1.55, 2.95), [30, 20]);
}

/// Compares the twin with the oracle for a golden file; more anchors and Gaussians than `least` must be in view.
fn assert_has_the_gaussians_of_its_format(name: &str, eye: DVec3, target: DVec3, least: [usize; 2]) {
    let root = root();
    let file = root.join("tests/golden").join(name);
    let mut script = Command::new("python3");
    script
        .arg(root.join("tests/oracles/gaussians.py"))
        .arg(&file)
        .args(eye.to_array().map(|v| v.to_string()));
    let Ok(output) = script.env("PYTHONDONTWRITEBYTECODE", "1").output() else {
        return skip("python3 is not installed");
    };
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let expected: Vec<Vec<Option<[f64; 14]>>> = serde_json::from_slice(&output.stdout).expect("JSON");

    let bytes = std::fs::read(file).expect("the golden file is committed");
    let scene = decode(&bytes, &DecodeLimits::default()).expect("decodes").scene;
    let rows = AnchorRows::from_scene(&scene);
    let networks = NetworkLayout::new(rows.shape).from_networks(&scene.networks).expect("a known shape");
    let anchors = twin::Anchors::new(&rows, &networks, scene.scene_scale);
    let pose = Pose::look_at(eye, target, DVec3::Z).expect("a view");
    let camera = Camera::new(Intrinsics::from_horizontal_fov(1.2, 64, 64).expect("a camera"), pose);
    let spawned = twin::neural_forward(&projection(&camera.expect("a camera")), &anchors);
    assert!(spawned.list.len() > least[0], "{} anchors are in view", spawned.list.len());

    let mut made = 0;
    for (anchor, found) in spawned.list.iter().zip(spawned.gaussians.chunks_exact(rows.shape.offsets)) {
        for (slot, (found, expected)) in found.iter().zip(&expected[*anchor as usize]).enumerate() {
            let found = found.as_ref().map(|g| -> Vec<f64> {
                let parts = [&g.mean.to_array()[..], &g.scale.to_array(), &g.quat, &g.color.to_array()];
                [&[g.opacity], &parts.concat()[..]].concat()
            });
            match (&found, expected) {
                (None, None) => {}
                (Some(found), Some(expected)) => {
                    made += 1;
                    // A quaternion is as good before it is normalized.
                    let length = found[7..11].iter().map(|v| v * v).sum::<f64>().sqrt();
                    for (index, expected) in expected.iter().enumerate() {
                        let scale = if (7..11).contains(&index) { length } else { 1.0 };
                        let off = (found[index] / scale - expected).abs();
                        let at = format!("anchor {anchor}, slot {slot}, number {index}");
                        assert!(off <= BOUND * expected.abs().max(1.0), "{at}: {} {expected}", found[index]);
                    }
                }
                // At the limit of existing.
                _ => {
                    let opacity = found.map_or_else(|| expected.map_or(0.0, |e| e[0]), |found| found[0]);
                    assert!(opacity.abs() < BOUND, "anchor {anchor}, slot {slot}: {opacity}");
                }
            }
        }
    }
    assert!(made > least[1], "{made} Gaussians");
}
