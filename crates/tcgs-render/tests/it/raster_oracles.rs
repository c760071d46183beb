//! The rasterizer against independent values: every case of `tests/oracles/splatting`, on the device and in the f64 twin.

use std::sync::Arc;

use tcgs_render::{Rasterizer, twin};

use crate::support::{
    gpu::gpu,
    oracle::{CASES, LARGE_CASE, Oracle, relative_l2},
    scene::{Scene, flat, render},
    sh::sh_backward,
};

/// Largest difference of a color on the device: blending in f32 differs by about 1e-6, a flipped 1/255 decision by 4e-3;
/// no case flips one.
const DEVICE_RGB: f64 = 1e-4;
/// The same for the twin, whose f64 arithmetic only orders its operations differently from the reference's.
const TWIN_RGB: f64 = 1e-12;
const TWIN_GRADIENTS: f64 = 1e-12;

/// The reference orders equal depths by an unstable sort, differently from tile to tile, so only what does not depend on
/// the order can be compared; that equal depths keep index order is tested in `raster_device`.
const UNORDERED: &str = "depth_ties";

/// What an implementation computed for a case.
struct Found {
    /// Color and transmittance.
    image: Vec<[f64; 4]>,
    d_means: Vec<[f64; 3]>,
    d_opacities: Vec<f64>,
    d_scales: Vec<f64>,
    d_quats: Vec<f64>,
    d_colors: Vec<Vec<f64>>,
    /// By visible Gaussian.
    d_means2d: Vec<f64>,
    d_conics: Option<Vec<f64>>,
}

fn worst(a: impl Iterator<Item = f64>, b: &[f64]) -> f64 {
    a.zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Names what exceeds the bounds.
fn compare(case: &str, oracle: &Oracle, found: &Found, rgb_bound: f64, bound: f64) -> Option<String> {
    let alpha = worst(found.image.iter().map(|pixel| 1.0 - pixel[3]), &oracle.numbers("f64.alpha"));
    let rgb = worst(found.image.iter().flat_map(|pixel| pixel[..3].to_vec()), &oracle.numbers("f64.rgb"));
    let (means, sh) = (oracle.rows("in.means", 3), oracle.rows("in.sh", 48));
    let (d_sh, by_color) = sh_backward(&means, &sh, oracle.eye(), &found.d_colors);
    let d_means: Vec<f64> =
        found.d_means.concat().iter().zip(by_color.concat()).map(|(a, b)| a + b).collect();
    let d_sh = d_sh.concat();
    let mut gradients = vec![
        ("v_means", &d_means),
        ("v_quats", &found.d_quats),
        ("v_scales", &found.d_scales),
        ("v_opacities", &found.d_opacities),
        ("v_sh", &d_sh),
        ("v_means2d", &found.d_means2d),
    ];
    gradients.extend(found.d_conics.as_ref().map(|values| ("v_conics", values)));
    let ordered = case != UNORDERED;
    let mut fine = alpha <= rgb_bound && (rgb <= rgb_bound || !ordered);
    let mut line = format!("{case:26} rgb {rgb:.1e} alpha {alpha:.1e}");
    for (name, values) in gradients {
        let error = relative_l2(values, &oracle.gradient(name));
        fine &= error <= bound || !ordered;
        line.push_str(&format!(" {name} {error:.1e}"));
    }
    println!("{line}");
    (!fine).then_some(line)
}

fn on_the_device(oracle: &Oracle, subgroups: bool) -> Found {
    let device = gpu();
    let scene = Scene::new(&oracle.gaussians());
    let d_image: Vec<[f32; 4]> = oracle.d_image().iter().map(|pixel| pixel.map(|v| v as f32)).collect();
    let background = oracle.background().as_vec3().to_array();
    let new = if subgroups { Rasterizer::new } else { Rasterizer::without_subgroups };
    let mut rasterizer = new(Arc::clone(&device), oracle.settings()).expect("a rasterizer");
    let got = render(&device, &mut rasterizer, &scene, &oracle.camera(), background, &d_image);
    let visible: Vec<[f32; 4]> = oracle.ids().iter().map(|id| got.d_means2d[*id]).collect();
    Found {
        image: got.image.iter().map(|pixel| pixel.map(f64::from)).collect(),
        d_means: got.d_means_opacity.iter().map(|row| [0, 1, 2].map(|i| f64::from(row[i]))).collect(),
        d_opacities: got.d_means_opacity.iter().map(|row| f64::from(row[3])).collect(),
        d_scales: flat(&got.d_scales, 3),
        d_quats: flat(&got.d_quats, 4),
        d_colors: got.d_colors.iter().map(|row| flat(&[*row], 3)).collect(),
        d_means2d: flat(&visible, 2),
        d_conics: None,
    }
}

fn in_the_twin(oracle: &Oracle) -> Found {
    let (projection, gaussians) = (oracle.projection(), oracle.gaussians());
    let cutoffs = twin::Cutoffs::default();
    let rendering = twin::forward(&projection, &gaussians, oracle.background(), cutoffs);
    let (d_splats, v) = twin::backward(&projection, &gaussians, &rendering, &oracle.d_image(), cutoffs);
    let visible: Vec<_> = oracle.ids().iter().map(|id| d_splats[*id]).collect();
    Found {
        image: rendering.frame.image,
        d_means: v.iter().map(|v| v.mean.to_array()).collect(),
        d_opacities: v.iter().map(|v| v.opacity).collect(),
        d_scales: v.iter().flat_map(|v| v.scale.to_array()).collect(),
        d_quats: v.iter().flat_map(|v| v.quat).collect(),
        d_colors: v.iter().map(|v| v.color.to_array().to_vec()).collect(),
        d_means2d: visible.iter().flat_map(|v| v.center.to_array()).collect(),
        d_conics: Some(visible.iter().flat_map(|v| v.conic.to_array()).collect()),
    }
}

fn device_fault(case: (&str, f64), oracle: &Oracle, subgroups: bool) -> Option<String> {
    compare(case.0, oracle, &on_the_device(oracle, subgroups), DEVICE_RGB, case.1)
}

fn twin_fault(case: &str, oracle: &Oracle) -> Option<String> {
    compare(case, oracle, &in_the_twin(oracle), TWIN_RGB, TWIN_GRADIENTS)
}

#[track_caller]
fn assert_none(faults: impl IntoIterator<Item = String>) {
    let faults = Vec::from_iter(faults);
    assert!(faults.is_empty(), "beyond the bounds:\n{}", faults.join("\n"));
}

#[test]
fn the_device_matches_the_oracles() {
    assert_none(CASES.iter().filter_map(|case| device_fault(*case, &Oracle::load(case.0), true)));
}

#[test]
fn the_kernels_without_subgroups_match_the_oracles() {
    assert_none(CASES.iter().filter_map(|case| device_fault(*case, &Oracle::load(case.0), false)));
}

#[test]
fn the_twin_matches_the_oracles() {
    assert_none(CASES.iter().filter_map(|(case, _)| twin_fault(case, &Oracle::load(case))));
}

#[test]
fn two_thousand_layers_that_saturate_match_the_oracle() {
    let Some(oracle) = Oracle::load_large() else { return };
    let device_faults = [true, false].map(|subgroups| device_fault(LARGE_CASE, &oracle, subgroups));
    assert_none(device_faults.into_iter().flatten().chain(twin_fault(LARGE_CASE.0, &oracle)));
}
