//! The kernels against the twins: Gaussians, gradients, statistics.

use std::sync::Arc;

use tcgs_codec::domain::{Camera, Lattice, Pose, SceneScale, ViewDegree};
use tcgs_render::{
    AnchorGradients, DeviceAnchors, NeuralGaussians, RasterSettings, Rasterizer, RenderError,
    gpu::{AdapterReport, Device, DeviceSettings, GpuError, Subgroups},
    model::{AnchorRows, ModelShape, NetworkLayout},
    twin::{GaussianGradient, neural as twin},
};

use super::scene::{Found, SMALL, Scene, USUAL, bits, projection, random_gradients, run};
use crate::support::{
    gpu::{gpu, gpu_with, has_wide_subgroups, variants},
    oracle::relative_l2,
    random,
    scene::flat,
};

const NEAR: f32 = 0.2;

/// f32 has 6e-8 of rounding; two layers of up to 96 products and a sum over a thousand anchors in runs come to some 1e-6. The
/// bound leaves room for adapters whose exp and tanh are good to a few units less.
const BOUND: f64 = 1e-4;

fn neural(shape: ModelShape, subgroups: bool) -> NeuralGaussians {
    neural_in(SceneScale::DEFAULT, shape, subgroups)
}

fn neural_in(scene_scale: SceneScale, shape: ModelShape, subgroups: bool) -> NeuralGaussians {
    let make = if subgroups { NeuralGaussians::new } else { NeuralGaussians::without_subgroups };
    make(gpu(), shape, NEAR, scene_scale).expect("the kernels")
}

fn assert_near(what: &str, found: &[f64], expected: &[f64]) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let error = relative_l2(found, expected);
    assert!(error < BOUND, "{what}: {error:e}");
}

/// Compares everything with the twin; returns how many anchors are visible.
fn assert_matches_twin(
    found: &Found,
    scene: &Scene,
    camera: &Camera,
    volume_weight: f64,
    seed: u64,
) -> usize {
    assert_matches_twin_with(found, scene, camera, volume_weight, seed, false)
}

fn assert_matches_twin_with(
    found: &Found,
    scene: &Scene,
    camera: &Camera,
    volume_weight: f64,
    seed: u64,
    masked: bool,
) -> usize {
    let (shape, projection) = (scene.anchors.shape, projection(camera));
    let anchors = scene.twin();
    let spawned = twin::neural_forward(&projection, &anchors);
    assert_eq!(found.counts, twin::count_gaussians(shape, &spawned.list, &spawned.gaussians));
    let opacities: Vec<f64> = found.gaussians[0].iter().map(|row| f64::from(row[3])).collect();
    let expected: Vec<f64> = spawned.gaussians.iter().map(|g| g.map_or(0.0, |g| g.opacity)).collect();
    assert_near("opacities", &opacities, &expected);
    let alive = |column: &[[f32; 4]], width: usize| -> Vec<f64> {
        let rows = column.iter().zip(&spawned.gaussians).filter(|(_, gaussian)| gaussian.is_some());
        flat(&rows.map(|(row, _)| *row).collect::<Vec<_>>(), width)
    };
    let gaussians = || spawned.gaussians.iter().flatten();
    let expected: Vec<f64> = gaussians().flat_map(|g| g.mean.to_array()).collect();
    assert_near("means", &alive(&found.gaussians[0], 3), &expected);
    let expected: Vec<f64> = gaussians().flat_map(|g| g.scale.to_array()).collect();
    assert_near("scales", &alive(&found.gaussians[1], 3), &expected);
    let expected: Vec<f64> = gaussians().flat_map(|g| g.quat).collect();
    assert_near("quaternions", &alive(&found.gaussians[2], 4), &expected);
    let expected: Vec<f64> = gaussians().flat_map(|g| g.color.to_array()).collect();
    assert_near("colors", &alive(&found.gaussians[3], 3), &expected);

    let gradients = random_gradients(seed, spawned.gaussians.len());
    let v: Vec<GaussianGradient> = gradients.iter().map(|(v, ..)| *v).collect();
    let expected = twin::neural_backward(&anchors, &spawned, &v, volume_weight);
    let ends = [0, shape.features, shape.features + 3, shape.offset_column(), shape.row()];
    for (what, range) in ["features", "reach", "size", "offsets"].into_iter().zip(ends.windows(2)) {
        let part = |rows: &[f64]| -> Vec<f64> {
            rows.chunks_exact(shape.row()).flat_map(|row| row[range[0]..range[1]].to_vec()).collect()
        };
        let rows: Vec<f64> = found.d_rows.iter().map(|v| f64::from(*v)).collect();
        assert_near(&format!("gradient of {what}"), &part(&rows), &part(&expected.rows));
    }
    for (anchor, row) in found.d_rows.chunks_exact(shape.row()).enumerate() {
        let seen = spawned.list.contains(&(anchor as u32));
        assert!(seen || row.iter().all(|v| *v == 0.0), "anchor {anchor} is not in view and has a gradient");
    }
    let networks: Vec<f64> = found.d_networks.iter().map(|v| f64::from(*v)).collect();
    let layout = NetworkLayout::new(shape);
    for layer in std::iter::once(&layout.hidden).chain(&layout.heads) {
        for (what, range) in
            [("weights", layer.weights..layer.bias), ("bias", layer.bias..layer.bias + layer.outputs)]
        {
            assert_near(
                &format!("gradient of {what} at {}", range.start),
                &networks[range.clone()],
                &expected.networks[range],
            );
        }
    }

    let width = 2 * shape.offsets + 2;
    let mut statistics = vec![1.0; scene.anchors.len() * width];
    for (index, anchor) in spawned.list.iter().enumerate() {
        let born = index * shape.offsets..(index + 1) * shape.offsets;
        let (splats, tiles): (Vec<_>, Vec<_>) =
            gradients[born.clone()].iter().map(|(_, v, t)| (*v, *t)).unzip();
        let row = &mut statistics[*anchor as usize * width..][..width];
        twin::anchor_statistics(&projection, &spawned.gaussians[born], &splats, &tiles, masked, row);
    }
    let found: Vec<f64> = found.statistics.iter().map(|v| f64::from(*v)).collect();
    assert_near("statistics", &found, &statistics);
    spawned.list.len()
}

fn check(shape: ModelShape, anchors: usize, spread: f32, subgroups: bool) -> usize {
    let device = gpu();
    let (camera, seed) = (random::camera(40, 30), anchors as u64);
    let scene = Scene::random(seed, shape, anchors, spread, &projection(&camera));
    let gradients = random_gradients(seed, anchors * shape.offsets);
    let mut neural = neural(shape, subgroups);
    let found = run(&device, &mut neural, &scene, &camera, 7.0, &gradients);
    assert_matches_twin(&found, &scene, &camera, 7.0, seed)
}

#[test]
fn with_masks_views_without_gradient_are_not_counted() {
    let device = gpu();
    let camera = random::camera(40, 30);
    let scene = Scene::random(5, SMALL, 40, 1.0, &projection(&camera));
    let gradients = random_gradients(5, 40 * SMALL.offsets);
    let mut neural = neural(SMALL, true);
    neural.count_views_with_gradient().expect("the kernel");
    let found = run(&device, &mut neural, &scene, &camera, 7.0, &gradients);
    assert!(assert_matches_twin_with(&found, &scene, &camera, 7.0, 5, true) > 0);
}

#[test]
fn a_few_anchors_match_the_twin() {
    for anchors in [1, 2, 63, 64, 65, 129] {
        for subgroups in [true, false] {
            assert_eq!(check(SMALL, anchors, 0.8, subgroups), anchors, "all are in view");
        }
    }
}

#[test]
fn distances_in_another_unit_match_the_twin() {
    let (device, camera) = (gpu(), random::camera(40, 30));
    for length in [0.003, 0.7, 250.0] {
        let scene_scale = SceneScale::new(length).expect("a length");
        let scene = Scene::random_in(scene_scale, 11, SMALL, 129, 0.8, &projection(&camera));
        let gradients = random_gradients(11, 129 * SMALL.offsets);
        let mut neural = neural_in(scene_scale, SMALL, true);
        let found = run(&device, &mut neural, &scene, &camera, 7.0, &gradients);
        assert_matches_twin(&found, &scene, &camera, 7.0, 11);
        let in_the_worlds = run(&device, &mut self::neural(SMALL, true), &scene, &camera, 7.0, &gradients);
        assert_ne!(bits(&found), bits(&in_the_worlds), "{length}");
    }
}

#[test]
fn harmonics_of_the_direction_match_the_twin() {
    for view_degree in ViewDegree::ALL {
        for shape in [SMALL, USUAL] {
            for subgroups in [true, false] {
                assert_eq!(check(ModelShape { view_degree, ..shape }, 130, 0.8, subgroups), 130);
            }
        }
    }
}

#[test]
fn more_anchors_than_one_gradient_run_match_the_twin() {
    for subgroups in [true, false] {
        assert_eq!(check(SMALL, 1025, 0.8, subgroups), 1025);
    }
}

#[test]
fn the_trained_widths_match_the_twin() {
    for subgroups in [true, false] {
        assert_eq!(check(USUAL, 130, 0.8, subgroups), 130);
    }
}

#[test]
fn the_published_widths_match_the_twin() {
    for subgroups in [true, false] {
        assert_eq!(check(ModelShape::new(50, 10), 130, 0.8, subgroups), 130);
    }
}

#[test]
fn anchors_that_are_partly_out_of_view_match_the_twin() {
    for subgroups in [true, false] {
        let visible = check(SMALL, 400, 5.0, subgroups);
        assert!((20..380).contains(&visible), "{visible} of 400");
    }
}

fn looking_away(camera: &Camera) -> Camera {
    let center = camera.pose.center();
    let pose = Pose::look_at(center, 2.0 * center, glam::DVec3::Z).expect("a view");
    Camera { pose, ..*camera }
}

#[test]
fn a_camera_that_looks_away_sees_nothing_and_teaches_nothing() {
    let device = gpu();
    let camera = random::camera(40, 30);
    let away = looking_away(&camera);
    let scene = Scene::random(1, SMALL, 70, 0.8, &projection(&camera));
    for subgroups in [true, false] {
        let mut neural = neural(SMALL, subgroups);
        let gradients = random_gradients(1, 70 * SMALL.offsets);
        // A view that shows everything comes first, so that its values lie in every buffer.
        assert_eq!(run(&device, &mut neural, &scene, &camera, 7.0, &gradients).counts[2], 70);
        let found = run(&device, &mut neural, &scene, &away, 7.0, &gradients);
        assert_eq!(found.counts, [0; 3]);
        assert!(found.d_rows.iter().chain(&found.d_networks).all(|v| *v == 0.0));
        assert!(found.statistics.iter().all(|v| *v == 1.0));
    }
}

#[test]
fn a_scene_without_anchors_is_a_view_without_gaussians() {
    let device = gpu();
    let camera = random::camera(40, 30);
    let scene = Scene::random(1, SMALL, 0, 0.8, &projection(&camera));
    for subgroups in [true, false] {
        let found = run(&device, &mut neural(SMALL, subgroups), &scene, &camera, 7.0, &[]);
        assert_eq!(found.counts, [0; 3]);
        assert!(found.d_networks.iter().all(|v| *v == 0.0));
    }
}

#[test]
fn an_anchor_whose_offsets_are_all_masked_makes_nothing_and_learns_nothing() {
    let device = gpu();
    let camera = random::camera(40, 30);
    let mut scene = Scene::random(2, SMALL, 65, 0.8, &projection(&camera));
    scene.anchors.masks[7] = 0;
    let gradients = random_gradients(2, 65 * SMALL.offsets);
    let found = run(&device, &mut neural(SMALL, true), &scene, &camera, 7.0, &gradients);
    assert_matches_twin(&found, &scene, &camera, 7.0, 2);
    assert!(found.gaussians[0][7 * SMALL.offsets..8 * SMALL.offsets].iter().all(|row| *row == [0.0; 4]));
    assert!(found.d_rows[7 * SMALL.row()..8 * SMALL.row()].iter().all(|v| *v == 0.0));
}

#[test]
fn both_variants_match_the_twin_where_many_anchors_make_nothing() {
    let camera = random::camera(40, 30);
    // Widths that are no multiple of four, and more inputs than an invocation holds at a time.
    for shape in [ModelShape::new(7, 6), ModelShape::new(37, 3)] {
        let mut scene = Scene::random(12, shape, 333, 2.0, &projection(&camera));
        for (anchor, mask) in scene.anchors.masks.iter_mut().enumerate() {
            *mask = if anchor % 3 == 1 { *mask } else { 0 };
        }
        let gradients = random_gradients(12, 333 * shape.offsets);
        for device in variants() {
            let mut neural =
                NeuralGaussians::new(Arc::clone(&device), shape, NEAR, SceneScale::DEFAULT).expect("kernels");
            let found = run(&device, &mut neural, &scene, &camera, 7.0, &gradients);
            assert!(assert_matches_twin(&found, &scene, &camera, 7.0, 12) > 100);
        }
    }
}

#[test]
fn the_same_input_gives_the_same_bits_whatever_was_rendered_before() {
    let device = gpu();
    let camera = random::camera(40, 30);
    let large = Scene::random(3, SMALL, 1500, 0.8, &projection(&camera));
    let small = Scene::random(4, SMALL, 129, 2.0, &projection(&camera));
    let gradients = random_gradients(3, 1500 * SMALL.offsets);
    for subgroups in [true, false] {
        let mut used = neural(SMALL, subgroups);
        let first = run(&device, &mut used, &large, &camera, 7.0, &gradients);
        let fresh = run(&device, &mut neural(SMALL, subgroups), &small, &camera, 7.0, &gradients);
        let after = run(&device, &mut used, &small, &camera, 7.0, &gradients);
        assert!(bits(&fresh) == bits(&after), "what a larger scene left behind is not read");
        let second = run(&device, &mut used, &large, &camera, 7.0, &gradients);
        assert!(bits(&first) == bits(&second));
    }
}

#[test]
fn with_and_without_subgroups_agree_up_to_rounding() {
    let device = gpu();
    let camera = random::camera(40, 30);
    let scene = Scene::random(5, USUAL, 200, 0.8, &projection(&camera));
    let gradients = random_gradients(5, 200 * USUAL.offsets);
    let [with, without] = [true, false]
        .map(|subgroups| run(&device, &mut neural(USUAL, subgroups), &scene, &camera, 7.0, &gradients));
    assert_eq!(with.counts, without.counts);
    let f64s = |values: &[f32]| -> Vec<f64> { values.iter().map(|v| f64::from(*v)).collect() };
    assert!(relative_l2(&f64s(&with.d_rows), &f64s(&without.d_rows)) < 1e-5);
    assert!(relative_l2(&f64s(&with.d_networks), &f64s(&without.d_networks)) < 1e-5);
}

#[test]
fn statistics_before_a_backward_pass_are_refused() {
    let device = gpu();
    let camera = random::camera(40, 30);
    let scene = Scene::random(6, SMALL, 3, 0.8, &projection(&camera));
    let near = RasterSettings::default().near;
    let neural =
        NeuralGaussians::new(Arc::clone(&device), SMALL, near, SceneScale::DEFAULT).expect("the kernels");
    let uploaded =
        tcgs_render::DeviceAnchors::upload(&device, &scene.anchors, &scene.networks).expect("room");
    let statistics = device.buffer("statistics", 3 * 8).expect("room");
    let mut recorder = device.recorder("statistics");
    let mark = device.buffer("overflow flag", 1).expect("room");
    let refused = neural.statistics(&mut recorder, &uploaded, &statistics, &mark);
    assert_eq!(refused, Err(RenderError::OutOfStep));
}

/// Whether the forward and backward pass of one view fit the device's bindings.
fn has_room(device: &Arc<Device>, shape: ModelShape, count: usize) -> bool {
    let layout = NetworkLayout::new(shape);
    let anchors = AnchorRows {
        shape,
        lattice: Lattice { voxel: 0.01, origin: [0.0; 3] },
        cells: (0..count).map(|i| [(i % 40) as i32, (i / 40) as i32, 0]).collect(),
        values: vec![0.0; count * shape.row()],
        masks: vec![(1 << shape.offsets) - 1; count],
    };
    let camera = random::camera(40, 30);
    let go = || {
        let uploaded = DeviceAnchors::upload(device, &anchors, &vec![0.01; layout.parameters])?;
        let out = AnchorGradients::plan(shape, count).make(device)?;
        let mut neural = NeuralGaussians::new(Arc::clone(device), shape, NEAR, SceneScale::DEFAULT)?;
        let mut raster = Rasterizer::new(Arc::clone(device), RasterSettings::default())?;
        let d_image = device.buffer("v_image", 40 * 30)?;
        let mut recorder = device.recorder("there and back");
        neural.forward(&mut recorder, &uploaded, &camera, 0.0)?;
        raster.forward(&mut recorder, neural.gaussians(), &camera, [0.0; 3])?;
        let gaussians = neural.gaussians().clone();
        let gradients = neural.gaussian_gradients()?.clone();
        raster.backward(&mut recorder, &gaussians, &camera, &d_image, &gradients)?;
        neural.backward(&mut recorder, &uploaded, &out)?;
        recorder.submit()?;
        Ok(device.wait()?)
    };
    match go() {
        Ok(()) => true,
        Err(RenderError::Gpu(GpuError::BufferTooLarge { .. })) => false,
        Err(error) => panic!("{count} anchors: {error}"),
    }
}

#[test]
fn a_forward_pass_can_be_gone_back_from_once() {
    let device = gpu();
    let camera = random::camera(40, 30);
    let scene = Scene::random(4, SMALL, 5, 0.8, &projection(&camera));
    let anchors = DeviceAnchors::upload(&device, &scene.anchors, &scene.networks).expect("anchors");
    let out = AnchorGradients::plan(SMALL, anchors.count).make(&device).expect("room");
    let mut neural = neural(SMALL, true);
    let mut recorder = device.recorder("passes");
    assert_eq!(neural.backward(&mut recorder, &anchors, &out), Err(RenderError::OutOfStep));
    for _ in 0..2 {
        neural.forward(&mut recorder, &anchors, &camera, 0.0).expect("recorded");
        assert_eq!(neural.backward(&mut recorder, &anchors, &out), Ok(()));
        assert_eq!(neural.backward(&mut recorder, &anchors, &out), Err(RenderError::OutOfStep));
    }
}

#[test]
fn the_most_anchors_are_what_the_widest_buffer_binds() {
    // What WebGPU guarantees. With 32 features the splats are the widest, with 50 the hidden values.
    for (features, expected) in [(32, 223_696), (50, 178_957)] {
        let shape = ModelShape::new(features, 10);
        let adapter = AdapterReport { max_binding_bytes: 128 << 20, ..gpu().adapter().clone() };
        assert_eq!(NeuralGaussians::max_anchors(&adapter, shape), expected);
        // The same of a device with narrower bindings, where all buffers are really made.
        let max_binding_bytes = Some(1 << 20);
        let device = gpu_with(DeviceSettings { max_binding_bytes, ..DeviceSettings::default() });
        let max = NeuralGaussians::max_anchors(device.adapter(), shape);
        assert!(has_room(&device, shape, max), "{max} anchors of {features} features");
        assert!(!has_room(&device, shape, max + 1), "{max} anchors are not the most");
    }
}

#[test]
fn subgroups_that_are_wider_than_a_workgroup_match_the_twin() {
    if !has_wide_subgroups("neural::device::subgroups_that_are_wider_than_a_workgroup_match_the_twin") {
        return;
    }
    let subgroups = Some(Subgroups::AtLeast(8));
    let device = gpu_with(DeviceSettings { subgroups, ..DeviceSettings::default() });
    let camera = random::camera(40, 30);
    let scene = Scene::random(7, USUAL, 200, 0.8, &projection(&camera));
    let gradients = random_gradients(7, 200 * USUAL.offsets);
    let mut neural =
        NeuralGaussians::new(Arc::clone(&device), USUAL, NEAR, SceneScale::DEFAULT).expect("the kernels");
    let found = run(&device, &mut neural, &scene, &camera, 7.0, &gradients);
    assert!(assert_matches_twin(&found, &scene, &camera, 7.0, 7) > 0);
}
