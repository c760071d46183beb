//! The rasterizer on the device: against the twin on random scenes, and on edge cases.

use std::sync::Arc;

use glam::{DVec3, DVec4};
use tcgs_codec::domain::Camera;
use tcgs_render::{
    CorrectionRows, ForwardPasses, GaussianGradients, Gaussians, Projection, RasterSettings, Rasterizer,
    RenderError,
    gpu::{Device, DeviceSettings, Subgroups},
    twin,
};

use crate::support::{
    gpu::{gpu, gpu_with, has_wide_subgroups, variants},
    oracle::relative_l2,
    random,
    scene::{Rendered, Scene, flat, render, spoiled_gradients},
};

const BACKGROUND: [f32; 3] = [0.2, 0.4, 0.8];

fn run(settings: RasterSettings, scene: &Scene, camera: &Camera) -> Rendered {
    run_on(&gpu(), settings, scene, camera)
}

fn run_on(device: &Arc<Device>, settings: RasterSettings, scene: &Scene, camera: &Camera) -> Rendered {
    let mut rasterizer = Rasterizer::new(Arc::clone(device), settings).expect("a rasterizer");
    let pixels = camera.intrinsics.width as usize * camera.intrinsics.height as usize;
    render(device, &mut rasterizer, scene, camera, BACKGROUND, &random::d_image(9, pixels))
}

fn gradients(rendered: &Rendered) -> Vec<f64> {
    let columns = [&rendered.d_means_opacity, &rendered.d_scales, &rendered.d_quats, &rendered.d_colors];
    columns.into_iter().flat_map(|column| flat(column, 4)).collect()
}

/// Bounds: f32 has 6e-8 of rounding; a few dozen operations and a few hundred terms a sum give 1e-6 to 1e-5. A decision at
/// 1/255 that f32 takes differently shows as up to 4e-3 in a pixel, so the image is bounded in L2.
fn matches_twin(seed: u64, count: usize, size: f64, width: u32, height: u32, settings: RasterSettings) {
    let scene = (seed, count, size);
    matches_twin_on(&gpu(), scene, random::camera(width, height), settings);
}

/// As [`matches_twin`], of a scene by its seed, count and size.
fn matches_twin_on(
    device: &Arc<Device>,
    (seed, count, size): (u64, usize, f64),
    camera: Camera,
    settings: RasterSettings,
) {
    let [width, height] = [camera.intrinsics.width, camera.intrinsics.height];
    let gaussians = random::gaussians(seed, count, size);
    let found = run_on(device, settings, &Scene::new(&gaussians), &camera);
    let projection = Projection::new(&camera, &settings);
    let background = DVec3::from(BACKGROUND.map(f64::from));
    let cutoffs = twin::Cutoffs::default();
    let rendering = twin::forward(&projection, &gaussians, background, cutoffs);
    let d_image: Vec<[f64; 4]> =
        random::d_image(9, (width * height) as usize).iter().map(|pixel| pixel.map(f64::from)).collect();
    let (d_splats, v) = twin::backward(&projection, &gaussians, &rendering, &d_image, cutoffs);
    let visible = rendering.splats.iter().flatten().count();
    assert!(found.counts.visible.abs_diff(visible as u32) <= 1, "{visible} visible");
    let image = relative_l2(&flat(&found.image, 4), &rendering.frame.image.concat());
    assert!(image < 1e-4, "image {image:e}");
    let columns: [(&str, Vec<f64>, Vec<f64>); 5] = [
        ("means", flat(&found.d_means_opacity, 3), v.iter().flat_map(|v| v.mean.to_array()).collect()),
        ("scales", flat(&found.d_scales, 3), v.iter().flat_map(|v| v.scale.to_array()).collect()),
        ("quats", flat(&found.d_quats, 4), v.iter().flat_map(|v| v.quat).collect()),
        ("colors", flat(&found.d_colors, 3), v.iter().flat_map(|v| v.color.to_array()).collect()),
        ("means2d", flat(&found.d_means2d, 2), d_splats.iter().flat_map(|v| v.center.to_array()).collect()),
    ];
    for (name, found, expected) in columns {
        let error = relative_l2(&found, &expected);
        assert!(error < 1e-4, "{name} {error:e}");
    }
    let tiles: Vec<f64> = found.d_means2d.iter().map(|row| f64::from(row[2])).collect();
    let expected: Vec<f64> = rendering.lists.tiles.iter().map(|tiles| f64::from(*tiles)).collect();
    assert!(relative_l2(&tiles, &expected) < 0.05, "tile counts differ only where rounding decides");
}

#[test]
fn random_scenes_match_the_twin() {
    let plain = RasterSettings::default();
    matches_twin(1, 300, 0.1, 64, 48, plain);
    matches_twin(2, 2000, 0.05, 67, 35, plain);
    matches_twin(3, 50, 1.0, 32, 80, plain);
    matches_twin(4, 300, 0.02, 64, 64, RasterSettings { antialiased: true, ..plain });
}

#[test]
fn removal_losses_match_the_twin() {
    removal_losses_match(None);
}

#[test]
fn removal_losses_of_corrected_renders_match_the_twin() {
    removal_losses_match(Some(&[[0.5, 0.1, -0.2, 0.05], [0.0, 1.4, 0.1, -0.1], [0.3, 0.2, 0.0, 0.1]]));
}

fn removal_losses_match(correction: Option<&CorrectionRows>) {
    let exact = correction.map(|rows| rows.map(|row| DVec4::from(row.map(f64::from))));
    for (device, (seed, count, size), [width, height]) in variants().into_iter().flat_map(|device| {
        [((1, 300, 0.1), [64, 48]), ((3, 50, 1.0), [33, 80])].map(|(s, c)| (device.clone(), s, c))
    }) {
        let camera = random::camera(width, height);
        let gaussians = random::gaussians(seed, count, size);
        let words: Vec<u32> = random::d_image(9, (width * height) as usize)
            .iter()
            .enumerate()
            .map(|(i, [r, g, b, _])| {
                let bytes = [r, g, b].map(|value| (value.abs().min(1.0) * 255.0) as u8);
                u32::from_le_bytes([bytes[0], bytes[1], bytes[2], if i % 5 == 0 { 0 } else { 255 }])
            })
            .collect();
        let settings = RasterSettings::default();
        let mut rasterizer = Rasterizer::new(Arc::clone(&device), settings).expect("a rasterizer");
        let uploaded = Scene::new(&gaussians).upload(&device);
        let out = spoiled_gradients(&device, count);
        let photograph = device.upload("photograph", &words).expect("room");
        rasterizer
            .submit_with_room("removal", |rasterizer, recorder| {
                rasterizer.forward(recorder, &uploaded, &camera, BACKGROUND)
            })
            .expect("a view");
        let mut recorder = device.recorder("removal");
        rasterizer
            .removal_loss(&mut recorder, &uploaded, &camera, &photograph, correction, &out)
            .expect("removal losses");
        recorder.submit().expect("submitted");
        let found: Vec<f64> = device
            .read_range(&out.geometry, 0, count)
            .expect("read")
            .iter()
            .map(|row| f64::from(row[3]))
            .collect();

        let projection = Projection::new(&camera, &settings);
        let cutoffs = twin::Cutoffs::default();
        let rendering =
            twin::forward(&projection, &gaussians, DVec3::from(BACKGROUND.map(f64::from)), cutoffs);
        let wanted: Vec<[f64; 4]> =
            words.iter().map(|word| word.to_le_bytes().map(|byte| f64::from(byte) / 255.0)).collect();
        let mut expected = vec![0.0; count];
        let slots = twin::removal_loss(&projection, &rendering, &wanted, exact.as_ref(), cutoffs);
        for (slot, loss) in slots.iter().enumerate() {
            expected[rendering.lists.slot_ids[slot] as usize] += loss;
        }
        let error = relative_l2(&found, &expected);
        assert!(error < 1e-4, "{error:e}");
    }
}

#[test]
fn images_smaller_than_a_tile_and_of_one_pixel_match_the_twin() {
    matches_twin(5, 100, 0.2, 1, 1, RasterSettings::default());
    matches_twin(6, 100, 0.2, 3, 17, RasterSettings::default());
}

#[test]
fn without_subgroups_the_result_is_the_same_up_to_rounding() {
    let device = gpu();
    let camera = random::camera(50, 40);
    let scene = Scene::new(&random::gaussians(8, 500, 0.1));
    let d_image = random::d_image(9, 2000);
    let mut plain =
        Rasterizer::without_subgroups(Arc::clone(&device), RasterSettings::default()).expect("one");
    let plain = render(&device, &mut plain, &scene, &camera, BACKGROUND, &d_image);
    let usual = run(RasterSettings::default(), &scene, &camera);
    assert!(relative_l2(&flat(&plain.image, 4), &flat(&usual.image, 4)) < 1e-6);
    assert!(relative_l2(&gradients(&plain), &gradients(&usual)) < 1e-5);
}

#[test]
fn both_variants_match_the_twin_and_give_the_same_bits() {
    let camera = random::camera(150, 70);
    let rendered = variants().map(|device| {
        matches_twin_on(&device, (2, 2000, 0.05), random::camera(67, 35), RasterSettings::default());
        // More Gaussians than the software variant has invocations.
        run_on(&device, RasterSettings::default(), &Scene::new(&random::gaussians(19, 9000, 0.03)), &camera)
    });
    assert!(rendered[0] == rendered[1]);
}

#[test]
fn workgroups_of_one_subgroup_give_the_same_bits() {
    let Some(lanes) = gpu().subgroups().lanes() else { return println!("an adapter without subgroups") };
    let device =
        gpu_with(DeviceSettings { subgroups: Some(Subgroups::AtLeast(lanes)), ..DeviceSettings::default() });
    assert_eq!(device.subgroups(), Subgroups::AtLeast(lanes));
    let camera = random::camera(150, 70);
    let scene = Scene::new(&random::gaussians(20, 2000, 0.05));
    let usual = run(RasterSettings::default(), &scene, &camera);
    assert!(run_on(&device, RasterSettings::default(), &scene, &camera) == usual);
}

#[test]
fn subgroups_that_are_wider_than_a_workgroup_match_the_twin() {
    if !has_wide_subgroups("raster_device::subgroups_that_are_wider_than_a_workgroup_match_the_twin") {
        return;
    }
    let subgroups = Some(Subgroups::AtLeast(8));
    let device = gpu_with(DeviceSettings { subgroups, ..DeviceSettings::default() });
    assert_eq!(device.subgroups(), Subgroups::AtLeast(8));
    matches_twin_on(&device, (2, 2000, 0.05), random::camera(67, 35), RasterSettings::default());
    matches_twin_on(&device, (3, 50, 1.0), random::camera(32, 80), RasterSettings::default());
}

#[test]
fn alternating_image_sizes_make_no_buffers_once_the_largest_was_seen() {
    // Others must not make buffers here meanwhile.
    let device = gpu_with(DeviceSettings::default());
    let mut rasterizer = Rasterizer::new(Arc::clone(&device), RasterSettings::default()).expect("one");
    let scene = Scene::new(&random::gaussians(21, 300, 0.1));
    let sizes = [(64, 48), (48, 64), (200, 30), (16, 16)];
    let mut view = |(width, height): (u32, u32)| {
        let camera = random::camera(width, height);
        let d_image = random::d_image(9, (width * height) as usize);
        let before = (device.buffers_made(), device.allocated_bytes());
        let found = render(&device, &mut rasterizer, &scene, &camera, BACKGROUND, &d_image);
        let fresh = run(RasterSettings::default(), &scene, &camera);
        assert!(found == fresh, "{width}x{height} after others");
        (device.buffers_made() - before.0, device.allocated_bytes() - before.1)
    };
    for size in sizes {
        view(size);
    }
    let again = view(sizes[3]);
    for size in [sizes, sizes].concat() {
        assert_eq!(view(size), again, "a view of another size after one of {size:?}");
    }
}

#[test]
fn the_same_input_gives_the_same_bits() {
    let camera = random::camera(64, 64);
    let scene = Scene::new(&random::gaussians(10, 3000, 0.1));
    let first = run(RasterSettings::default(), &scene, &camera);
    let second = run(RasterSettings::default(), &scene, &camera);
    assert!(first == second);
}

#[test]
fn equal_depths_keep_index_order() {
    let camera = random::camera(32, 32);
    let toward = camera.pose.center().normalize();
    let mut gaussians = random::gaussians(11, 100, 0.3);
    for (gaussian, i) in gaussians.iter_mut().zip(0..) {
        gaussian.mean = DVec3::ZERO;
        gaussian.color = toward * 0.0 + DVec3::new(f64::from(i % 2), f64::from(i % 3) / 2.0, 0.5);
    }
    let found = run(RasterSettings::default(), &Scene::new(&gaussians), &camera);
    let projection = Projection::new(&camera, &RasterSettings::default());
    let background = DVec3::from(BACKGROUND.map(f64::from));
    let expected = twin::forward(&projection, &gaussians, background, twin::Cutoffs::default());
    let in_order = relative_l2(&flat(&found.image, 4), &expected.frame.image.concat());
    assert!(in_order < 1e-5, "{in_order:e}");
    gaussians.reverse();
    let reversed = twin::forward(&projection, &gaussians, background, twin::Cutoffs::default());
    assert!(
        relative_l2(&flat(&found.image, 4), &reversed.frame.image.concat()) > 1e-2,
        "the test sees the order"
    );
}

/// Nothing but the background, and zero gradients.
fn assert_empty(rendered: &Rendered) {
    let [r, g, b] = BACKGROUND;
    assert!(rendered.image.iter().all(|pixel| *pixel == [r, g, b, 1.0]));
    assert!(gradients(rendered).iter().chain(&flat(&rendered.d_means2d, 4)).all(|v| *v == 0.0));
    assert_eq!((rendered.counts.visible, rendered.counts.intersections), (0, 0));
}

#[test]
fn a_rasterizer_serves_scenes_and_images_of_all_sizes_in_turn() {
    let device = gpu();
    let mut shared = Rasterizer::new(Arc::clone(&device), RasterSettings::default()).expect("one");
    for (count, width, height) in [(300, 64, 64), (20, 16, 16), (900, 200, 30), (0, 8, 8), (300, 64, 64)] {
        let camera = random::camera(width, height);
        let scene = Scene::new(&random::gaussians(17, count, 0.1));
        let d_image = random::d_image(9, (width * height) as usize);
        let found = render(&device, &mut shared, &scene, &camera, BACKGROUND, &d_image);
        assert!(found == run(RasterSettings::default(), &scene, &camera), "{count} at {width}x{height}");
    }
}

#[test]
fn one_recording_may_hold_several_views() {
    let device = gpu();
    let scene = Scene::new(&random::gaussians(18, 200, 0.2));
    let gaussians = scene.upload(&device);
    let cameras = [random::camera(40, 40), random::camera(24, 50)];
    let mut rasterizer = Rasterizer::new(Arc::clone(&device), RasterSettings::default()).expect("one");
    let mut recorder = device.recorder("two views");
    let images = cameras.map(|camera| {
        rasterizer.forward(&mut recorder, &gaussians, &camera, BACKGROUND).expect("recorded");
        let image = rasterizer.image();
        let copy = device.buffer::<[f32; 4]>("copy", image.len()).expect("room");
        recorder.copy(image, 0, &copy, 0, image.len());
        copy
    });
    recorder.submit().expect("submitted");
    for (image, camera) in images.iter().zip(cameras) {
        assert!(device.read(image).expect("read") == run(RasterSettings::default(), &scene, &camera).image);
    }
}

#[test]
fn an_empty_scene_is_background() {
    assert_empty(&run(RasterSettings::default(), &Scene::default(), &random::camera(20, 20)));
}

#[test]
fn rows_beyond_the_count_are_left_out_and_never_written() {
    let device = gpu();
    let camera = random::camera(20, 20);
    let scene = Scene::new(&random::gaussians(12, 64, 0.2));
    let gaussians = scene.upload(&device);
    const USED: usize = 20;
    device.write(&gaussians.count, &[USED as u32]);
    let mut rasterizer = Rasterizer::new(Arc::clone(&device), RasterSettings::default()).expect("one");
    let out = spoiled_gradients(&device, 64);
    let d_image = device.upload("v", &random::d_image(1, 400)).expect("a buffer");
    let mut recorder = device.recorder("both passes in one recording");
    rasterizer.forward(&mut recorder, &gaussians, &camera, BACKGROUND).expect("recorded");
    rasterizer.backward(&mut recorder, &gaussians, &camera, &d_image, &out).expect("recorded");
    recorder.submit().expect("submitted");
    let image = device.read(rasterizer.image()).expect("an image");
    let alone = run(RasterSettings::default(), &Scene::new(&random::gaussians(12, 64, 0.2)[..USED]), &camera);
    assert!(image == alone.image);
    let [geometry, colors, means2d] =
        [&out.geometry, &out.colors, &out.means2d].map(|buffer| device.read(buffer).expect("gradients"));
    for section in geometry.chunks(64).chain([&colors[..], &means2d]) {
        assert!(section[..USED].iter().flatten().all(|value| value.is_finite()));
        assert!(section[USED..].iter().flatten().all(|value| value.is_nan()), "nobody reads them");
    }
}

#[test]
fn gaussians_that_cannot_be_drawn_are_culled_and_the_others_are_not_disturbed() {
    let camera = random::camera(40, 40);
    let good = random::gaussians(13, 40, 0.2);
    let broken: Vec<twin::Gaussian> = (0..12)
        .map(|kind| {
            let mut g = good[kind];
            match kind {
                0 => g.mean.x = f64::NAN,
                1 => g.mean.z = f64::INFINITY,
                2 => g.opacity = f64::NAN,
                3 => g.scale.y = f64::NAN,
                4 => g.scale.x = f64::INFINITY,
                5 => g.quat = [0.0; 4],
                6 => g.quat[2] = f64::NAN,
                7 => g.color.y = f64::NAN,
                8 => g.opacity = -0.5,
                9 => g.opacity = 0.0039,
                10 => g.scale = DVec3::splat(1e30),
                _ => g.mean = camera.pose.center() * 2.0,
            }
            g
        })
        .collect();
    assert_empty(&run(RasterSettings::default(), &Scene::new(&broken), &camera));
    let mixed: Vec<_> = good.iter().copied().chain(broken).collect();
    let alone = run(RasterSettings::default(), &Scene::new(&good), &camera);
    let mixed = run(RasterSettings::default(), &Scene::new(&mixed), &camera);
    assert!(alone.image == mixed.image);
    assert!(
        alone.d_scales[..] == mixed.d_scales[..40] && mixed.d_scales[40..].iter().all(|v| *v == [0.0; 4])
    );
}

#[test]
fn huge_gaussians_cover_everything() {
    let camera = random::camera(70, 40);
    let mut gaussians = random::gaussians(14, 3, 0.2);
    for gaussian in &mut gaussians {
        gaussian.scale = DVec3::splat(1e4);
        gaussian.opacity = 0.5;
    }
    let found = run(RasterSettings::default(), &Scene::new(&gaussians), &camera);
    assert_eq!(found.counts.intersections, 3 * 5 * 3);
    assert!(found.image.iter().all(|pixel| (pixel[3] - 0.125).abs() < 1e-4));
    assert!(gradients(&found).iter().all(|v| v.is_finite()));
}

#[test]
fn gradients_are_finite_at_every_scale() {
    let camera = random::camera(48, 48);
    for power in -12..=18 {
        for thin in [1.0, 1e-3, 1e-6] {
            let mut gaussians = random::gaussians(16, 20, 1.0);
            for gaussian in &mut gaussians {
                gaussian.scale *= 10.0_f64.powi(power) * DVec3::new(1.0, thin, 1.0);
                gaussian.quat = gaussian.quat.map(|v| v * 1e10);
            }
            for antialiased in [false, true] {
                let settings = RasterSettings { antialiased, ..RasterSettings::default() };
                let found = run(settings, &Scene::new(&gaussians), &camera);
                let finite = found.image.iter().flatten().all(|v| v.is_finite());
                assert!(finite, "image at 1e{power}, {thin}, {antialiased}");
                assert!(gradients(&found).iter().all(|v| v.is_finite()), "1e{power}, {thin}, {antialiased}");
            }
        }
    }
}

#[test]
fn overflow_is_reported_and_growing_gives_what_enough_room_would_have() {
    let device = gpu();
    let camera = random::camera(256, 256);
    let mut gaussians = random::gaussians(15, 200, 0.5);
    for gaussian in &mut gaussians {
        gaussian.scale = DVec3::splat(2.0);
        gaussian.opacity = 0.05;
    }
    let scene = Scene::new(&gaussians);
    let uploaded = scene.upload(&device);
    let mut rasterizer = Rasterizer::new(Arc::clone(&device), RasterSettings::default()).expect("one");
    let mut recorder = device.recorder("forward");
    rasterizer.forward(&mut recorder, &uploaded, &camera, BACKGROUND).expect("recorded");
    recorder.submit().expect("submitted");
    let counts = rasterizer.counts().expect("counts");
    assert!(counts.overflowed && counts.intersections > 16_384, "{counts:?}");
    let failed = ForwardPasses { completed: 0, required: Some(counts.intersections as usize) };
    assert_eq!(rasterizer.take_forward_passes(), Ok(failed));
    let d_image = random::d_image(9, 256 * 256);
    let grown = render(&device, &mut rasterizer, &scene, &camera, BACKGROUND, &d_image);
    assert_eq!(
        rasterizer.take_forward_passes(),
        Ok(failed),
        "what lacked room is told of although room was made since"
    );
    let again = render(&device, &mut rasterizer, &scene, &camera, BACKGROUND, &d_image);
    assert_eq!(rasterizer.take_forward_passes(), Ok(ForwardPasses { completed: 1, required: None }));
    assert_eq!(rasterizer.take_forward_passes(), Ok(ForwardPasses { completed: 0, required: None }));
    assert_eq!(grown.counts.intersections, counts.intersections);
    assert!(grown == again);
    let projection = Projection::new(&camera, &RasterSettings::default());
    let background = DVec3::from(BACKGROUND.map(f64::from));
    let expected = twin::forward(&projection, &gaussians, background, twin::Cutoffs::default());
    assert!(relative_l2(&flat(&grown.image, 4), &expected.frame.image.concat()) < 1e-4);
}

#[test]
fn a_backward_pass_of_another_camera_is_refused() {
    let device = gpu();
    let gaussians = Gaussians::plan(4, 1).make(&device).expect("room");
    let out = GaussianGradients::plan(4).make(&device).expect("room");
    let d_image = device.buffer("v", 100).expect("a buffer");
    let (camera, other) = (random::camera(10, 10), random::camera(10, 11));
    let mut rasterizer = Rasterizer::new(Arc::clone(&device), RasterSettings::default()).expect("one");
    let mut recorder = device.recorder("backward");
    let early = rasterizer.backward(&mut recorder, &gaussians, &camera, &d_image, &out);
    assert_eq!(early, Err(RenderError::OutOfStep));
    rasterizer.forward(&mut recorder, &gaussians, &camera, BACKGROUND).expect("recorded");
    assert_eq!(
        rasterizer.backward(&mut recorder, &gaussians, &other, &d_image, &out),
        Err(RenderError::OutOfStep)
    );
    let short = device.buffer("v", 99).expect("a buffer");
    let refused = rasterizer.backward(&mut recorder, &gaussians, &camera, &short, &out);
    assert!(matches!(refused, Err(RenderError::Length { found: 99, expected: 100, .. })));
    rasterizer.backward(&mut recorder, &gaussians, &camera, &d_image, &out).expect("recorded");
    recorder.submit().expect("submitted");
}
