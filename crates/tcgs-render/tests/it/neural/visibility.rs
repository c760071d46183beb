//! The visible anchors of a view, and their list.

use glam::{DMat3, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs_codec::domain::{Camera, Intrinsics, Lattice, Pose, SceneScale};
use tcgs_render::{
    AnchorGradients, DeviceAnchors, NeuralGaussians, Projection, RasterSettings, RenderError,
    gpu::{BLOCK, kernel_source},
    model::{AnchorRows, NetworkLayout},
    twin::neural as twin,
};

use super::scene::{SMALL, Scene, projection, random_gradients, run};
use crate::support::{gpu::gpu, random};

/// The row of an anchor of this reach.
fn row_of(reach: DVec3) -> Vec<f64> {
    let mut row = vec![0.0; SMALL.row()];
    reach.map(f64::ln).write_to_slice(&mut row[SMALL.scaling_column()..]);
    row
}

/// Brute force: the covariance of an axis-aligned Gaussian through the Jacobian as a matrix product.
fn box_touches(projection: &Projection, position: DVec3, reach: DVec3) -> bool {
    let p = projection.rotation * position + projection.translation;
    if p.z <= projection.near {
        return false;
    }
    let (low, high) = projection.slopes();
    let slope = (p.truncate() / p.z).clamp(low, high);
    let jacobian = DMat3::from_cols(
        DVec3::new(projection.focal.x / p.z, 0.0, 0.0),
        DVec3::new(0.0, projection.focal.y / p.z, 0.0),
        DVec3::new(-projection.focal.x * slope.x / p.z, -projection.focal.y * slope.y / p.z, 0.0),
    );
    let m = jacobian * projection.rotation;
    let covariance = m * DMat3::from_diagonal(reach * reach) * m.transpose();
    let radius = 3.0 * DVec2::new(covariance.col(0).x + 0.3, covariance.col(1).y + 0.3).map(f64::sqrt);
    let center = projection.focal * p.truncate() / p.z + projection.center;
    let size = projection.size.as_dvec2();
    center.x + radius.x > 0.0
        && center.y + radius.y > 0.0
        && center.x - radius.x < size.x
        && center.y - radius.y < size.y
}

#[test]
fn an_anchor_is_shown_exactly_if_its_box_touches_the_image() {
    let projection = projection(&random::camera(40, 30));
    let mut rng = Pcg64::seed_from_u64(1);
    let mut shown = 0;
    for _ in 0..20_000 {
        let position = DVec3::from([0; 3].map(|_| rng.random_range(-6.0..6.0)));
        let reach = DVec3::from([0; 3].map(|_| rng.random_range(-6.0..1.0_f64).exp()));
        let expected = box_touches(&projection, position, reach);
        let found = twin::anchor_visible(&projection, position, SMALL, &row_of(reach));
        assert_eq!(found, expected, "{position} {reach}");
        shown += usize::from(found);
    }
    assert!((2_000..18_000).contains(&shown), "{shown}");
}

#[test]
fn every_anchor_whose_center_is_in_the_image_beyond_the_near_plane_is_shown() {
    let camera = random::camera(40, 30);
    let projection = projection(&camera);
    let mut rng = Pcg64::seed_from_u64(2);
    let row = row_of(DVec3::splat(1e-6));
    let mut inside = 0;
    for _ in 0..20_000 {
        let position = DVec3::from([0; 3].map(|_| rng.random_range(-2.0..2.0)));
        let Some((pixel, depth)) = camera.project(position) else { continue };
        if depth > 0.2 && pixel.cmpge(DVec2::ZERO).all() && pixel.cmple(DVec2::new(40.0, 30.0)).all() {
            inside += 1;
            assert!(twin::anchor_visible(&projection, position, SMALL, &row));
        }
    }
    assert!(inside > 1000, "{inside}");
}

/// Anchors on the optical axis of a camera that looks along z, at these depths, all of whose offsets make Gaussians.
fn on_the_axis(depths: &[i32], voxel: f32) -> (Scene, Camera) {
    let layout = NetworkLayout::new(SMALL);
    let mut networks = vec![0.0; layout.parameters];
    networks[layout.heads[0].bias..][..SMALL.offsets].fill(1.0);
    let mut values = vec![0.0; depths.len() * SMALL.row()];
    for row in values.chunks_exact_mut(SMALL.row()) {
        row[SMALL.scaling_column()..SMALL.offset_column()].fill(-3.0);
    }
    let anchors = AnchorRows {
        shape: SMALL,
        lattice: Lattice { voxel, origin: [0.0; 3] },
        cells: depths.iter().map(|depth| [0, 0, *depth]).collect(),
        values,
        masks: vec![7; depths.len()],
    };
    let intrinsics = Intrinsics { fx: 50.0, fy: 50.0, cx: 20.0, cy: 15.0, width: 40, height: 30 };
    let pose = Pose::from_world_to_camera(DMat3::IDENTITY, DVec3::ZERO).expect("a pose");
    (Scene { anchors, networks, scene_scale: SceneScale::DEFAULT }, Camera { intrinsics, pose })
}

fn depths_shown(scene: &Scene, camera: &Camera) -> Vec<f32> {
    let device = gpu();
    let mut neural =
        NeuralGaussians::new(device.clone(), SMALL, 0.2, SceneScale::DEFAULT).expect("the kernels");
    let gradients = random_gradients(1, scene.anchors.len() * SMALL.offsets);
    let found = run(&device, &mut neural, scene, camera, 0.0, &gradients);
    found.gaussians[0].iter().step_by(SMALL.offsets).map(|row| row[2]).collect()
}

#[test]
fn anchors_at_the_near_plane_or_nearer_are_not_shown() {
    // In sixteenths: the near plane of 0.2 lies between 3 and 4.
    let (scene, camera) = on_the_axis(&[-1600, -16, 0, 1, 3, 4, 16, 1600], 1.0 / 16.0);
    assert_eq!(depths_shown(&scene, &camera), [0.25, 1.0, 100.0]);
    // Exactly on the plane: not shown, as the rasterizer would cull it too.
    let (scene, camera) = on_the_axis(&[1, 2], 0.2);
    assert_eq!(depths_shown(&scene, &camera), [0.4]);
}

#[test]
fn the_twin_draws_the_same_line_at_the_near_plane() {
    let (scene, camera) = on_the_axis(&[-1600, -16, 0, 1, 3, 4, 16, 1600], 1.0 / 16.0);
    let settings = RasterSettings::default();
    let spawned = twin::neural_forward(&Projection::new(&camera, &settings), &scene.twin());
    assert_eq!(spawned.list, [5, 6, 7]);
}

#[test]
fn the_device_shows_the_anchors_that_the_twin_shows() {
    let camera = random::camera(40, 30);
    let projection = projection(&camera);
    let (mut scene, _) = on_the_axis(&[], 1.0);
    let random = Scene::random(8, SMALL, 2000, 6.0, &projection);
    scene.anchors = AnchorRows { masks: vec![7; 2000], ..random.anchors };
    let twin = twin::neural_forward(&projection, &scene.twin());
    assert!((200..1800).contains(&twin.list.len()), "{}", twin.list.len());
    let device = gpu();
    let mut neural =
        NeuralGaussians::new(device.clone(), SMALL, 0.2, SceneScale::DEFAULT).expect("the kernels");
    // With offsets of zero a Gaussian lies at its anchor.
    for row in scene.anchors.values.chunks_exact_mut(SMALL.row()) {
        row[SMALL.offset_column()..].fill(0.0);
    }
    let gradients = random_gradients(1, 2000 * SMALL.offsets);
    let found = run(&device, &mut neural, &scene, &camera, 0.0, &gradients);
    let list = device.read(neural.visible_list()).expect("read");
    let (count, rest) = list.split_first().expect("a count");
    assert!(rest[..*count as usize] == twin.list, "{count} and {} anchors", twin.list.len());
    let positions = scene.anchors.positions();
    let shown = found.gaussians[0].iter().step_by(SMALL.offsets);
    assert_eq!(shown.len(), twin.list.len());
    for (shown, anchor) in shown.zip(&twin.list) {
        // Rounded twice on the way to the camera and back, at coordinates up to 6.
        let apart = (0..3).map(|axis| (shown[axis] - positions[*anchor as usize][axis]).abs());
        assert!(apart.fold(0.0, f32::max) < 2e-6, "anchor {anchor}: {shown:?}");
    }
}

/// Lists the set flags by the kernels of software adapters or of hardware, and compares with their twins; nothing else is written.
fn assert_listed(visible: &[bool], what: &str) {
    let device = gpu();
    let count = visible.len();
    let flags: Vec<u32> = visible.iter().map(|v| u32::from(*v)).collect();
    let mut view = [[0xdead_beef_u32; 4]; 7];
    view[6] = [count as u32, count as u32, 0, 0];
    let view = device.upload("view", &view).expect("view");
    let flags = device.upload("flags", &flags).expect("flags");
    let blocks = count.div_ceil(BLOCK).max(1);
    let block_counts = device.upload("junk", &vec![0xdead_beef_u32; blocks + 1]).expect("counts");
    let [software, hardware] =
        [(); 2].map(|()| device.upload("junk", &vec![0xdead_beef_u32; count + 2]).expect("list"));
    let kernel = |source| device.kernel(source, &[]).expect("the kernel");
    let mut recorder = device.recorder("lists");
    recorder.dispatch(&kernel(kernel_source!("compact_anchors")), &[&view, &flags, &software], 1);
    let groups = blocks as u32;
    recorder.dispatch(
        &kernel(kernel_source!("count_visible_anchors")),
        &[&view, &flags, &block_counts],
        groups,
    );
    recorder.dispatch(
        &kernel(kernel_source!("list_visible_anchors")),
        &[&view, &flags, &block_counts, &hardware],
        groups,
    );
    recorder.submit().expect("submitted");
    let expected = twin::compact_anchors(visible);
    let counts = twin::count_visible_anchors(visible);
    let found = device.read(&block_counts).expect("counts");
    assert_eq!(found[..counts.len()], counts, "{what}");
    assert_eq!(found[blocks], 0xdead_beef, "nothing beyond the blocks: {what}");
    assert!(twin::list_visible_anchors(visible, &counts) == expected, "{what}");
    for list in [software, hardware] {
        let found = device.read(&list).expect("list");
        assert_eq!(found[0] as usize, expected.len(), "{what}");
        assert!(found[1..=expected.len()] == expected, "{what}");
        assert!(found[expected.len() + 1..].iter().all(|v| *v == 0xdead_beef), "nothing beyond: {what}");
    }
}

#[test]
fn the_list_is_ascending_complete_and_counted() {
    let mut rng = Pcg64::seed_from_u64(3);
    for count in [0, 1, 2, 255, 256, 257, 1025, 2047, 2048, 2049, 70_001, 600_000] {
        for share in [0.0, 0.01, 0.5, 1.0] {
            let visible: Vec<bool> = (0..count).map(|_| rng.random::<f64>() < share).collect();
            assert_listed(&visible, &format!("{count} anchors, {share} of them visible"));
        }
    }
}

/// Offsets that a view shows by the twin, and those so close to the smallest visible opacity that rounding decides.
fn shown_by_the_twin(scene: &Scene, camera: &Camera) -> (Vec<u32>, Vec<u32>) {
    let (anchors, projection) = (scene.twin(), projection(camera));
    let forward = twin::neural_forward(&projection, &anchors);
    let mut shown = vec![0; anchors.positions.len()];
    let mut close = shown.clone();
    for (anchor, outputs) in forward.list.iter().map(|anchor| *anchor as usize).zip(&forward.outputs) {
        let (position, row) = (anchors.positions[anchor], anchors.row(anchor));
        shown[anchor] = twin::visible_offsets(position, SMALL, row, anchors.masks[anchor], outputs);
        for (k, output) in outputs[..SMALL.offsets].iter().enumerate() {
            close[anchor] |= u32::from((output.tanh() - 1.0 / 255.0).abs() < 1e-5) << k;
        }
    }
    (shown, close)
}

#[test]
fn offsets_that_any_view_shows_are_marked_and_no_others() {
    let device = gpu();
    let cameras = [random::camera(40, 30), random::camera(30, 40)];
    let mut scene = Scene::random(31, SMALL, 300, 4.0, &projection(&cameras[0]));
    // Opacities around the smallest that reaches a pixel.
    let layout = NetworkLayout::new(SMALL);
    let opacity = &layout.heads[0];
    for weight in &mut scene.networks[opacity.weights..][..opacity.inputs * opacity.outputs] {
        *weight *= 0.01;
    }
    // A position and a size that are not finite, of offsets that would be shown.
    let (shown, _) = shown_by_the_twin(&scene, &cameras[0]);
    let mut first = (0..shown.len()).filter(|anchor| shown[*anchor] != 0);
    let [nowhere, endless] = [(); 2].map(|()| first.next().expect("two anchors are shown"));
    let offset = shown[nowhere].trailing_zeros();
    let values = &mut scene.anchors.values;
    values[nowhere * SMALL.row() + SMALL.offset_column() + 3 * offset as usize] = f32::NAN;
    values[endless * SMALL.row() + SMALL.scaling_column() + 4] = f32::INFINITY;
    let uploaded = DeviceAnchors::upload(&device, &scene.anchors, &scene.networks).expect("anchors");
    let mut neural =
        NeuralGaussians::new(device.clone(), SMALL, 0.2, SceneScale::DEFAULT).expect("the kernels");
    let marked = device.upload("visible offsets", &vec![0_u32; scene.anchors.len()]).expect("a buffer");
    let (mut expected, mut close) = (vec![0; scene.anchors.len()], vec![0; scene.anchors.len()]);
    for camera in &cameras {
        let mut recorder = device.recorder("visible offsets");
        neural.visible_offsets(&mut recorder, &uploaded, camera, &marked).expect("recorded");
        recorder.submit().expect("submitted");
        let (shown, near) = shown_by_the_twin(&scene, camera);
        expected.iter_mut().zip(shown).for_each(|(all, shown)| *all |= shown);
        close.iter_mut().zip(near).for_each(|(all, near)| *all |= near);
        let found = device.read(&marked).expect("read");
        for (anchor, (found, expected)) in found.iter().zip(&expected).enumerate() {
            assert_eq!(found & !close[anchor], expected & !close[anchor], "anchor {anchor}");
        }
    }
    let count = |words: &[u32]| words.iter().map(|word| word.count_ones()).sum::<u32>();
    let unmasked = count(&scene.anchors.masks);
    assert!((50..unmasked - 50).contains(&count(&expected)) && count(&close) < 10, "{}", count(&expected));
    let found = device.read(&marked).expect("read");
    assert_eq!([found[nowhere] & 1 << offset, found[endless]], [0; 2]);

    // Nothing to differentiate: the networks were not evaluated whole.
    let out = AnchorGradients {
        rows: device.buffer("rows", scene.anchors.values.len()).expect("a buffer"),
        networks: device.buffer("networks", layout.parameters).expect("a buffer"),
    };
    let mut recorder = device.recorder("backward");
    assert!(matches!(neural.backward(&mut recorder, &uploaded, &out), Err(RenderError::OutOfStep)));
}
