//! The rasteriser against independent values: every case of `shared/oracles`, on the device and in the f64 twin.

use std::sync::Arc;

use tcgs::render::Rasterizer;

use crate::support::{
    gpu::gpu,
    oracle::{CASES, Oracle, relative_l2},
    scene::{Scene, flat, render},
    sh::sh_backward,
};

/// Largest difference of a colour: f32 blending strays by 1e-6 or so, one flipped 1/255 decision by 4e-3; no case flips.
const RGB_BOUND: f64 = 1e-4;

fn device_matches(subgroups: bool) {
    let context = gpu();
    let mut faults = Vec::new();
    for (case, bound) in CASES {
        let Some(oracle) = Oracle::load(case) else { return };
        let (means, sh) = (oracle.rows("in.means", 3), oracle.rows("in.sh", 48));
        let scene = Scene::from_rows(
            &means,
            &oracle.numbers("in.opacities"),
            &oracle.rows("in.scales", 3),
            &oracle.rows("in.quats", 4),
            &oracle.colors,
        );
        let v_image: Vec<[f32; 4]> = oracle
            .rows("in.v_rgb", 3)
            .iter()
            .zip(oracle.numbers("in.v_alpha"))
            .map(|(rgb, alpha)| [rgb[0] as f32, rgb[1] as f32, rgb[2] as f32, alpha as f32])
            .collect();
        let background = oracle.numbers("in.bg");
        let background = [0, 1, 2].map(|i| background[i] as f32);
        let new = if subgroups { Rasterizer::new } else { Rasterizer::without_subgroups };
        let mut rasterizer = new(Arc::clone(&context), oracle.settings()).expect("a rasteriser");
        let got = render(&context, &mut rasterizer, &scene, &oracle.camera(), background, &v_image);

        let rgb = flat(&got.image, 3);
        let alpha: Vec<f64> = got.image.iter().map(|pixel| 1.0 - f64::from(pixel[3])).collect();
        let worst = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let rgb = worst(&rgb, &oracle.numbers("f64.rgb"));
        let alpha = worst(&alpha, &oracle.numbers("f64.alpha"));

        let v_colors: Vec<Vec<f64>> = got.v_colors.iter().map(|row| flat(&[*row], 3)).collect();
        let (v_sh, v_means) = sh_backward(&means, &sh, oracle.eye(), &v_colors);
        let v_means: Vec<f64> =
            flat(&got.v_means_opacity, 3).iter().zip(v_means.concat()).map(|(a, b)| a + b).collect();
        let v_opacities: Vec<f64> = got.v_means_opacity.iter().map(|row| f64::from(row[3])).collect();
        let visible: Vec<[f32; 4]> = oracle.ids().iter().map(|id| got.v_means2d[*id]).collect();
        let v_means2d = flat(&visible, 2);
        let mut line = format!("{case:26} rgb {rgb:.1e} alpha {alpha:.1e}");
        let mut fine = rgb <= RGB_BOUND && alpha <= RGB_BOUND;
        for (name, values) in [
            ("v_means", &v_means),
            ("v_quats", &flat(&got.v_quats, 4)),
            ("v_scales", &flat(&got.v_scales, 3)),
            ("v_opacities", &v_opacities),
            ("v_sh", &v_sh.concat()),
            ("v_means2d", &v_means2d),
        ] {
            let error = relative_l2(values, &oracle.gradient(name));
            fine &= error <= bound;
            line.push_str(&format!(" {name} {error:.1e}"));
        }
        println!("{line}");
        if !fine {
            faults.push(line);
        }
    }
    assert!(faults.is_empty(), "beyond the bounds:\n{}", faults.join("\n"));
}

#[test]
fn the_device_matches_the_oracles() {
    device_matches(true);
}

#[test]
fn the_kernels_without_subgroups_match_the_oracles() {
    device_matches(false);
}
