//! NaN and infinity: an anchor that holds one does not affect the others.

use tcgs_codec::domain::SceneScale;
use tcgs_render::model::all_offsets;
use tcgs_render::{NeuralGaussians, model::NetworkLayout};

use super::scene::{Found, SMALL, Scene, projection, random_gradients, run};
use crate::support::{gpu::gpu, random};

const ANCHORS: usize = 66;

fn found(scene: &Scene, subgroups: bool) -> Found {
    let make = if subgroups { NeuralGaussians::new } else { NeuralGaussians::without_subgroups };
    let mut neural = make(gpu(), SMALL, 0.2, SceneScale::DEFAULT).expect("the kernels");
    let gradients = random_gradients(1, ANCHORS * SMALL.offsets);
    run(&gpu(), &mut neural, scene, &random::camera(40, 30), 7.0, &gradients)
}

fn scene() -> Scene {
    Scene::random(9, SMALL, ANCHORS, 0.8, &projection(&random::camera(40, 30)))
}

/// Sets one value of the last anchor to NaN or infinity, and expects the others' results as if that anchor did not exist.
fn spoil(column: usize, value: f32, subgroups: bool) {
    let what = format!("{value} in column {column}, subgroups {subgroups}");
    let mut scene = scene();
    scene.anchors.masks[ANCHORS - 1] = 0;
    let others = (ANCHORS - 1) * SMALL.row();
    let candidates = (ANCHORS - 1) * SMALL.offsets;
    let expected = found(&scene, subgroups);
    scene.anchors.masks[ANCHORS - 1] = 7;
    scene.anchors.values[others + column] = value;
    let found = found(&scene, subgroups);
    for (found, expected) in found.gaussians.iter().zip(&expected.gaussians) {
        assert!(found[..candidates] == expected[..candidates], "{what}: the others' Gaussians");
        assert!(found.iter().flatten().all(|v| v.is_finite()), "{what}: a Gaussian is not finite");
    }
    if found.counts[1] == expected.counts[1] {
        assert!(found.d_rows[..others] == expected.d_rows[..others], "{what}: the others' gradients");
        // Zeros added in another place of a sum may change a zero's sign but nothing else.
        assert!(found.d_networks == expected.d_networks, "{what}: the networks' gradients");
    }
    assert!(found.d_rows[..others].iter().all(|v| v.is_finite()), "{what}: the others' gradients");
    assert!(found.d_networks.iter().all(|v| v.is_finite()), "{what}: the networks' gradients");
}

#[test]
fn an_anchor_whose_row_is_not_finite_disturbs_neither_other_anchors_nor_the_networks() {
    let columns = [
        0,
        SMALL.features - 1,
        SMALL.scaling_column(),
        SMALL.scaling_column() + 3,
        SMALL.offset_column(),
        SMALL.row() - 1,
    ];
    for subgroups in [true, false] {
        for column in columns {
            for value in [f32::NAN, f32::INFINITY, 1e38] {
                spoil(column, value, subgroups);
            }
        }
    }
}

#[test]
fn networks_that_are_not_finite_do_not_stop_the_device() {
    for (index, value) in [(0, f32::NAN), (3, f32::INFINITY), (400, f32::NAN)] {
        let mut scene = scene();
        scene.networks[index] = value;
        let found = found(&scene, true);
        assert_eq!(found.counts[2] as usize, ANCHORS);
        assert!(found.gaussians[0].iter().all(|row| row[3] >= 0.0), "no opacity is NaN");
    }
}

/// The opacities, and the gradients by the networks, where the first head outputs `output` for every offset of every anchor.
fn with_opacity_output(output: f32) -> Found {
    let mut scene = scene();
    scene.anchors.masks.fill(all_offsets(SMALL));
    let head = NetworkLayout::new(SMALL).heads[0];
    scene.networks[head.weights..head.weights + head.inputs * head.outputs].fill(0.0);
    scene.networks[head.bias..head.bias + head.outputs].fill(output);
    found(&scene, true)
}

#[test]
fn an_output_however_large_is_an_opacity_of_one_or_none() {
    for output in [10.0, 100.0, 1e30, f32::MAX] {
        let opaque = with_opacity_output(output);
        assert!(
            opaque.counts[1] > 0 && opaque.counts[1] == opaque.counts[0],
            "{output}: {:?}",
            opaque.counts
        );
        assert!(opaque.gaussians[0].iter().all(|row| row[3] == 1.0), "{output}");
        assert!(opaque.d_networks.iter().all(|value| value.is_finite()), "{output}");
        let none = with_opacity_output(-output);
        assert_eq!(none.counts[1], 0, "-{output}");
        assert!(none.gaussians[0].iter().all(|row| *row == [0.0; 4]), "-{output}");
    }
}

#[test]
fn an_output_that_is_no_number_makes_no_gaussian() {
    for output in [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let found = with_opacity_output(output);
        assert_eq!(found.counts[1], 0, "{output}");
        assert!(found.gaussians[0].iter().all(|row| *row == [0.0; 4]), "{output}");
        assert!(found.d_networks.iter().all(|value| value.is_finite()), "{output}");
    }
}
