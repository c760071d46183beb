//! Baking on scenes whose outcome is known.

use super::*;
use crate::domain::{
    DenseLayer, Intrinsics, Lattice, Mlp, NearPlane, Pose, RenderNetworks, SceneFrame, SceneScale, ViewDegree,
};

const FEATURES: usize = 2;

/// A network of one layer: outputs that do not depend on the view but where `slopes` says so (output, view input, slope).
fn network(bias: &[f32], slopes: &[(usize, usize, f32)]) -> Mlp {
    let inputs = FEATURES + 4;
    let mut weights = vec![0.0; inputs * bias.len()];
    for (output, input, slope) in slopes {
        weights[output * inputs + FEATURES + input] = *slope;
    }
    Mlp { layers: vec![DenseLayer { inputs, outputs: bias.len(), weights, bias: bias.to_vec() }] }
}

/// One anchor at (1, 0, 0) with two offsets, of which the second is half a unit above it.
fn scene() -> AnchorScene {
    let offset = [0.0, 0.0, 0.0, 1.0, 2.0, 0.0, 0.0];
    AnchorScene {
        near: NearPlane::DEFAULT,
        scene_scale: SceneScale::DEFAULT,
        frame: SceneFrame::WORLD,
        lattice: Lattice { voxel: 0.5, origin: [0.0; 3] },
        cells: vec![[2, 0, 0]],
        feature_dim: FEATURES,
        offsets_per_anchor: 2,
        features: vec![0.3, -0.1],
        scalings: vec![0.5, 0.5, 0.5, 0.02, 0.04, 0.08],
        offsets: vec![0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        masks: vec![true, true],
        networks: RenderNetworks {
            opacity: network(&[0.5, 1.0], &[]),
            covariance: network(&[offset, offset].concat(), &[]),
            color: network(&[0.0, 1.0, -1.0, 0.5, 0.5, 0.5], &[]),
        },
    }
}

fn cameras() -> Vec<Camera> {
    sphere(&[[1.0, 0.0, 0.0], [1.0, 0.0, 0.5], [1.0, 0.5, 0.5]], 60, 64).expect("cameras")
}

#[test]
fn a_scene_that_looks_the_same_from_everywhere_is_baked_exactly() {
    let baked = bake(&scene(), &cameras(), BakeSettings::default()).expect("bakes");
    assert_eq!((baked.unseen, baked.views, baked.scene.degree), (0, 60, 3));
    let gaussians = baked.scene;
    gaussians.check().expect("sound");
    assert_eq!(gaussians.means, [[1.0, 0.0, 0.0], [1.0, 0.0, 0.5]]);
    let close =
        |found: f32, expected: f64| assert!((f64::from(found) - expected).abs() < 1e-5, "{found} {expected}");
    for (k, logit) in [0.5_f64, 1.0].into_iter().enumerate() {
        let opacity = logit.tanh();
        close(gaussians.opacity_logits[k], (opacity / (1.0 - opacity)).ln());
        let part = [0.5, 0.5, 0.5];
        for (axis, size) in [0.02, 0.04, 0.08].into_iter().enumerate() {
            close(gaussians.log_scales[k][axis], f64::ln(size * part[axis]));
        }
        let length = 5.0_f64.sqrt();
        for (found, expected) in gaussians.quats[k].into_iter().zip([1.0 / length, 2.0 / length, 0.0, 0.0]) {
            close(found, expected);
        }
        for channel in 0..3 {
            let value = [[0.0, 1.0, -1.0], [0.5; 3]][k][channel];
            close(gaussians.sh[k][0][channel], (logistic(value) - 0.5) / harmonics::CONSTANT);
        }
        assert!(
            gaussians.sh[k][1..].as_flattened().iter().all(|value| value.abs() < 1e-6),
            "{:?}",
            gaussians.sh[k]
        );
    }
}

#[test]
fn a_color_that_turns_with_the_view_is_met_to_a_percent() {
    let mut scene = scene();
    scene.networks.color =
        network(&[0.0, 0.2, -0.5, 0.0, 0.0, 0.0], &[(0, 0, 1.5), (1, 2, -1.0), (2, 1, 0.7)]);
    let cameras = cameras();
    for (degree, bound) in [(3, 0.01), (1, 0.05), (0, 1.0)] {
        let baked = bake(&scene, &cameras, BakeSettings { degree, ridge: 1e-6 }).expect("bakes");
        let mut worst: f64 = 0.0;
        for camera in &cameras {
            let d = (DVec3::X - camera.pose.center()).normalize();
            let truth = [1.5 * d.x, 0.2 - d.z, 0.7 * d.y - 0.5].map(logistic);
            let basis = harmonics::basis(d);
            for (channel, truth) in truth.into_iter().enumerate() {
                let sum: f64 =
                    basis.iter().zip(&baked.scene.sh[0]).map(|(b, c)| b * f64::from(c[channel])).sum();
                worst = worst.max((sum + 0.5 - truth).abs());
            }
        }
        assert!(worst < bound, "degree {degree}: off by {worst}");
        assert_eq!(baked.scene.degree, degree);
        assert!(baked.scene.sh[0][harmonics::functions(degree)..].as_flattened().iter().all(|v| *v == 0.0));
    }
}

#[test]
fn opacity_is_the_mean_over_the_views_that_show_it() {
    let mut scene = scene();
    // Born where the view direction has a positive x, one half of the sphere.
    scene.networks.opacity = network(&[0.0, -1.0], &[(0, 0, 40.0)]);
    let baked = bake(&scene, &cameras(), BakeSettings::default()).expect("bakes");
    assert_eq!(baked.unseen, 1, "the second is born nowhere");
    let opacity = logistic(f64::from(baked.scene.opacity_logits[0]));
    assert!((opacity - 0.5).abs() < 0.05, "{opacity}");
    // Views without the Gaussian do not contribute to its color.
    scene.networks.color = network(&[0.0; 6], &[(0, 0, 40.0)]);
    let red =
        bake(&scene, &cameras(), BakeSettings { degree: 0, ridge: 0.0 }).expect("bakes").scene.sh[0][0][0];
    assert!(f64::from(red) * harmonics::CONSTANT + 0.5 > 0.95, "{red}");
}

#[test]
fn rotations_of_either_sign_are_one_rotation() {
    let mut sum = [0.0; 4];
    add_rotation(&mut sum, [1.0, 0.1, 0.0, 0.0], 1.0);
    add_rotation(&mut sum, [-2.0, 0.2, 0.0, 0.0], 1.0);
    add_rotation(&mut sum, [0.0; 4], 1.0);
    add_rotation(&mut sum, [f64::NAN; 4], 1.0);
    assert!(sum[0] > 1.9 && sum[1].abs() < 1e-9, "{sum:?}");
}

#[test]
fn what_is_off_or_out_of_sight_is_left_out_and_counted_apart() {
    let mut scene = scene();
    scene.masks[0] = false;
    let baked = bake(&scene, &cameras(), BakeSettings::default()).expect("bakes");
    assert_eq!((baked.scene.len(), baked.unseen), (1, 0));
    let k = Intrinsics::from_horizontal_fov(0.5, 32, 32).expect("intrinsics");
    let away = Pose::look_at(DVec3::new(5.0, 0.0, 0.0), DVec3::new(9.0, 0.0, 0.0), DVec3::Z).expect("a pose");
    let away = Camera::new(k, away).expect("a camera");
    let error = bake(&scene, &[away], BakeSettings::default()).expect_err("nothing is in view");
    assert_eq!(error, BakeError::Empty { offsets: 1, views: 1 });
}

#[test]
fn a_scene_in_a_tiny_unit_is_seen_from_its_own_near_plane() {
    let place = |point: [f32; 3]| point.map(|coordinate| 1e-3 * coordinate);
    let points = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.5], [1.0, 0.5, 0.5]].map(place);
    let cameras = sphere(&points, 60, 64).expect("cameras");
    let mut tiny = scene();
    tiny.lattice.voxel *= 1e-3;
    tiny.scalings.iter_mut().for_each(|scaling| *scaling *= 1e-3);
    assert!(bake(&tiny, &cameras, BakeSettings::default()).is_err(), "all of it is nearer than 0.2");
    tiny.near = NearPlane::of_extent(1e-3);
    let baked = bake(&tiny, &cameras, BakeSettings::default()).expect("bakes");
    assert_eq!((baked.unseen, baked.scene.near, baked.scene.len()), (0, tiny.near, 2));
}

#[test]
fn the_networks_are_told_distances_in_the_scenes_unit() {
    let mut world = scene();
    // The first offset's opacity and red tell the distance.
    world.networks.opacity = network(&[0.2, 1.0], &[(0, 3, 0.1)]);
    world.networks.color = network(&[0.0, 1.0, -1.0, 0.5, 0.5, 0.5], &[(0, 3, 0.2)]);
    let expected = bake(&world, &cameras(), BakeSettings::default()).expect("bakes").scene;
    let points = [[4.0, 0.0, 0.0], [4.0, 0.0, 2.0], [4.0, 2.0, 2.0]];
    let cameras = sphere(&points, 60, 64).expect("cameras");
    let mut scaled = world;
    scaled.lattice.voxel *= 4.0;
    scaled.scalings.iter_mut().for_each(|scaling| *scaling *= 4.0);
    let differ = |scaled: &AnchorScene| {
        let found = bake(scaled, &cameras, BakeSettings::default()).expect("bakes").scene;
        let opacities = found.opacity_logits.iter().zip(&expected.opacity_logits);
        let colors =
            found.sh.as_flattened().as_flattened().iter().zip(expected.sh.as_flattened().as_flattened());
        opacities.chain(colors).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    assert!(differ(&scaled) > 0.1, "scaled_distance in the world's unit, it is another scene");
    scaled.scene_scale = SceneScale::new(4.0).expect("a length");
    assert!(differ(&scaled) < 1e-4, "{}", differ(&scaled));
}

#[test]
fn harmonics_of_the_direction_become_colors_of_their_degree() {
    let view_degree = ViewDegree::MAX;
    let inputs = FEATURES + view_degree.inputs();
    let mut scene = scene();
    // The green of the first offset is a lobe of degree 2, the blue one of degree 3.
    let lobes = [(1, 4, 0.2), (2, 14, -0.3)];
    let RenderNetworks { opacity, covariance, color } = &mut scene.networks;
    for layer in [opacity, covariance, color].into_iter().flat_map(|mlp| &mut mlp.layers) {
        let rows = layer.weights.chunks(layer.inputs);
        layer.weights = rows.flat_map(|row| row.iter().copied().chain([0.0; 12])).collect();
        layer.inputs = inputs;
    }
    for (output, input, weight) in lobes {
        scene.networks.color.layers[0].weights[output * inputs + FEATURES + input] = weight;
    }
    let baked = bake(&scene, &cameras(), BakeSettings::default()).expect("bakes").scene;
    let size = |function: usize| {
        let degree = f64::from(harmonics::degree_of(function));
        (4.0 * std::f64::consts::PI / (2.0 * degree + 1.0)).sqrt()
    };
    // Biases are 1 and -1, where the logistic is this steep.
    let slope = logistic(1.0) * logistic(-1.0);
    for (channel, function, weight) in [(1, 4, 0.2), (2, 14, -0.3)] {
        let found = f64::from(baked.sh[0][function][channel]);
        let expected = slope * weight * size(function);
        assert!((found - expected).abs() < 0.05 * expected.abs(), "{function}: {found} {expected}");
    }
}

#[test]
fn faults_are_named() {
    let settings = BakeSettings::default();
    assert_eq!(bake(&scene(), &[], settings), Err(BakeError::NoViews));
    assert_eq!(bake(&scene(), &cameras(), BakeSettings { degree: 4, ..settings }), Err(BakeError::Degree(4)));
    let mut torn = scene();
    torn.features.pop();
    assert!(matches!(bake(&torn, &cameras(), settings), Err(BakeError::Scene(_))));
    let mut wild = scene();
    wild.scalings.fill(f32::MAX);
    wild.offsets.fill(f32::MAX);
    if let Ok(baked) = bake(&wild, &cameras(), settings) {
        baked.scene.check().expect("finite");
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let mut scene = scene();
    scene.networks.color = network(&[0.0; 6], &[(0, 0, 1.5), (4, 2, -1.0)]);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| bake(&scene, &cameras(), BakeSettings::default())).expect("bakes")
    };
    assert_eq!(with(1), with(4));
}

#[test]
fn candidates_have_values_of_the_views_that_see_their_anchor_alone() {
    let scene = scene();
    // Each of the cameras that look at the scene, then one at the same place that looks away.
    let away = |camera: &Camera| {
        let from = camera.pose.center();
        let pose = Pose::look_at(from, 2.0 * from - DVec3::X, DVec3::new(0.3, 0.5, 0.8)).expect("a pose");
        Camera::new(camera.intrinsics, pose).expect("a camera")
    };
    let seeing = cameras();
    let all: Vec<Camera> = seeing.iter().flat_map(|camera| [*camera, away(camera)]).collect();
    let bake_views: Vec<BakeView> = all.iter().map(BakeView::of).collect();
    let settings = BakeSettings::default();
    let mut candidates =
        [AnchorSampler { scene: &scene, bake_views: &bake_views, settings, anchor: 0 }.candidates()];
    add_shares(&mut candidates, &bake_views, f64::from(scene.near.depth()));
    let [Candidates { views, list }] = &candidates;
    assert!(views.iter().copied().eq((0..120).step_by(2)), "{views:?}");
    assert_eq!(list.len(), 2);
    assert!(list.iter().all(|candidate| candidate.opacities.len() == 60 && candidate.shares.len() == 60));
    let [of_all, of_seeing] =
        [&all, &seeing].map(|cameras| bake(&scene, cameras, settings).expect("bakes").scene);
    assert_eq!(of_all, of_seeing);
}
