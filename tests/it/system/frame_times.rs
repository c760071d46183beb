//! A measurement: how long the viewer page takes for a picture of many Gaussians in Chromium, where WebGPU is SwiftShader on the
//! processor, and how long the program takes for the same picture. `make frame-times` prints both.

use std::{fs, process::Output};

use tcgs::{
    codec::{DecodeLimits, EncodeSettings, decode, encode},
    domain::AnchorScene,
    viewer_page::assets,
};

use super::viewer_page::{CAMERA, SHOWN, WEBGPU};
use crate::support::{
    browser::{self, Page},
    program,
    skip::skip,
};

/// Pictures of the page that are timed.
const PICTURES: usize = 5;
const SIZE: [u32; 2] = [640, 480];

fn tcgs(arguments: &[&str]) -> Output {
    let output = program::command().args(arguments).output().expect("the program");
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

/// A file of `copies` of a scene that training made, side by side in a square.
fn tiled(copies: usize) -> Vec<u8> {
    let golden = include_bytes!("../../golden/trained_v1.tcgs");
    let decoded = decode(golden, &DecodeLimits::default()).expect("a scene");
    let one = decoded.scene;
    let width = |axis: usize| {
        let cells = || one.cells.iter().map(|cell| cell[axis]);
        cells().max().unwrap_or(0) - cells().min().unwrap_or(0) + 1
    };
    let side = (copies as f64).sqrt().ceil() as usize;
    let shift = |copy: usize| [(copy % side) as i32 * width(0), (copy / side) as i32 * width(1), 0];
    let moved = |copy: usize| {
        let by = shift(copy);
        one.cells.iter().map(move |cell| [cell[0] + by[0], cell[1] + by[1], cell[2] + by[2]])
    };
    let scene = AnchorScene {
        cells: (0..copies).flat_map(moved).collect(),
        features: one.features.repeat(copies),
        scalings: one.scalings.repeat(copies),
        offsets: one.offsets.repeat(copies),
        masks: one.masks.repeat(copies),
        ..one.clone()
    };
    let steps = decoded.manifest.steps;
    let settings = EncodeSettings {
        background: decoded.manifest.background,
        feature_step: steps.feature,
        scaling_step: steps.scaling / one.lattice.voxel,
        offset_step: steps.offset,
        context: Default::default(),
        provenance: decoded.manifest.provenance,
    };
    encode(&scene, None, &settings).expect("a file").bytes
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a measurement: prints times"]
async fn times_of_pictures_in_the_page_and_of_the_program() {
    let Some(browser) = browser::find() else { return skip("Chromium is not installed") };
    if assets().is_none() {
        return skip("the viewer for browsers was not built: scripts/web.sh does, before the program");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    let [width, height] = SIZE;
    for copies in [7, 70] {
        fs::write(path("scene.tcgs"), tiled(copies)).expect("written");
        tcgs(&["export", &path("scene.tcgs"), "--output", &path("scene.html")]);
        let mut page = Page::open_with(browser, &WEBGPU, &format!("file://{}", path("scene.html"))).await;
        page.resize(width, height).await;
        page.until(SHOWN, |shown| *shown == "webgpu").await;
        let mut times = Vec::new();
        for _ in 0..PICTURES {
            page.evaluate("document.getElementById('stage').focus()").await;
            page.key("ArrowLeft").await;
            page.until("document.getElementById('stage').dataset.picture", |picture| *picture == "full")
                .await;
            let line = page.evaluate("document.getElementById('line').textContent").await;
            let line = line.as_str().expect("words").to_owned();
            assert!(line.contains(&format!("{width}×{height}")), "{line}");
            times.push(line);
        }
        println!("in the page: {}", times.join("; "));
        fs::write(path("camera.json"), page.evaluate(CAMERA).await.as_str().expect("a camera"))
            .expect("written");
        let sizes = format!("{width}x{height}");
        let arguments =
            ["bench", "views", &path("scene.tcgs"), "--pose", &path("camera.json"), "--sizes", &sizes];
        println!("the program:\n{}", String::from_utf8_lossy(&tcgs(&arguments).stdout));
    }
}
