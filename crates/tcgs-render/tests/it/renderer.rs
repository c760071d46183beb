//! Finished scenes on the device: 8-bit views against the twins, the viewer's memory, and its recovery from a lost device.

use std::{cell::Cell, sync::Arc};

use glam::DVec3;
use tcgs_codec::domain::{AnchorScene, Background, Digest, Lattice, Scene, SceneScale};
use tcgs_render::{
    PackedImage, Projection, RasterSettings, RenderError, RenderViews, Renderer, SceneViewer,
    model::{AnchorRows, ModelShape, NetworkLayout},
    twin::{self, neural},
    views::{MIN_VISIBLE_ALPHA, ScalarKind, Viewable},
};

use crate::support::{
    gpu::{choice, gpu},
    random,
};

const SHAPE: ModelShape = ModelShape::new(4, 2);

/// A hundred anchors in a spiral, and their rows.
fn scene() -> (AnchorRows, Vec<f32>, AnchorScene) {
    let layout = NetworkLayout::new(SHAPE);
    let wave = |i: usize| (i as f32 * 0.7).sin();
    let networks: Vec<f32> = (0..layout.parameters).map(|i| 0.8 * wave(i)).collect();
    let cells = (0..100).map(|i| [(80.0 * wave(i)) as i32, (80.0 * wave(i + 5)) as i32, i as i32]).collect();
    let values = (0..100 * SHAPE.row())
        .map(|i| match i % SHAPE.row() {
            column if (4..10).contains(&column) => -1.5 + 0.3 * wave(i),
            _ => wave(3 * i),
        })
        .collect();
    let lattice = Lattice { voxel: 0.01, origin: [0.0, 0.0, -0.5] };
    let rows = AnchorRows { shape: SHAPE, lattice, cells, values, masks: vec![3; 100] };
    let finished = rows.to_scene(layout.to_networks(&networks));
    (rows, networks, finished)
}

#[test]
fn a_view_is_the_twins_view_in_8_bits() {
    let (rows, networks, mut finished) = scene();
    let camera = random::camera(45, 37);
    for (background, scene_scale) in
        [(Background::White, 1.0), (Background::Black, 1.0), (Background::Black, 2.5)]
    {
        finished.scene_scale = SceneScale::new(scene_scale).expect("a length");
        let mut renderer = Renderer::new(&gpu(), &finished, background).expect("a renderer");
        let image = renderer.render(&camera).expect("a view");
        let projection = Projection::new(&camera, &RasterSettings::default());
        let spawned = neural::neural_forward(
            &projection,
            &neural::Anchors::new(&rows, &networks, finished.scene_scale),
        );
        let gaussians: Vec<_> = spawned.gaussians.into_iter().flatten().collect();
        let behind = DVec3::from(background.rgb().map(f64::from));
        let twin = twin::forward(&projection, &gaussians, behind, twin::Cutoffs::default());
        let expected = twin.frame.image.iter().flat_map(|p| [p[0], p[1], p[2]]);
        assert_eq!((image.width(), image.height(), image.channels()), (45, 37, 3));
        let covered = twin.frame.image.iter().filter(|pixel| pixel[3] < 0.5).count();
        assert!(covered > 100, "the scene is in view: {covered} pixels");
        for (found, expected) in image.samples().iter().zip(expected) {
            // Half a level of rounding to 8 bits, and a contribution at 1/255 that f32 decides otherwise.
            let expected = 255.0 * expected.clamp(0.0, 1.0);
            assert!((f64::from(*found) - expected).abs() < 1.6, "{found} {expected}");
        }
        assert_eq!(renderer.render(&camera), Ok(image), "the same view again, bit for bit");
    }
}

#[test]
fn views_of_a_sequence_are_those_of_single_views() {
    let (_, _, finished) = scene();
    let mut renderer = Renderer::new(&gpu(), &finished, Background::White).expect("a renderer");
    let cameras = [(45, 37), (45, 37), (64, 16), (45, 37), (8, 8)].map(|(w, h)| random::camera(w, h));
    let alone = cameras.each_ref().map(|camera| renderer.render(camera).expect("a view"));
    let sequence: Result<Vec<_>, _> = renderer.views(cameras.into_iter()).collect();
    assert_eq!(sequence.as_deref(), Ok(alone.as_slice()));
    // A sequence that is not taken to its end leaves nothing behind.
    let first = renderer.views(cameras.into_iter()).next();
    assert_eq!(first, Some(Ok(alone[0].clone())));
    assert_eq!(renderer.render(&cameras[2]).as_ref(), Ok(&alone[2]));
}

#[test]
fn a_sequence_on_a_lost_device_ends_with_its_loss() {
    let (_, _, finished) = scene();
    let device = tcgs_render::gpu::Device::new(&choice()).expect("a device");
    let mut renderer = Renderer::new(&device, &finished, Background::White).expect("a renderer");
    let mut views = renderer.views(std::iter::repeat(random::camera(45, 37)));
    views.next().expect("a view").expect("rendered");
    device.destroy();
    let found = views.next().expect("an outcome");
    assert!(matches!(found, Err(RenderError::Gpu(_))), "{found:?}");
}

#[test]
fn depth_and_alpha_are_the_twins() {
    let (rows, networks, finished) = scene();
    let camera = random::camera(45, 37);
    let mut renderer = Renderer::new(&gpu(), &finished, Background::White).expect("a renderer");
    let depth = renderer.plane(&camera, ScalarKind::Depth).expect("a view");
    let alpha = renderer.plane(&camera, ScalarKind::Alpha).expect("a view");
    assert_eq!((depth.width, depth.height, alpha.width, alpha.height), (45, 37, 45, 37));

    let projection = Projection::new(&camera, &RasterSettings::default());
    let spawned =
        neural::neural_forward(&projection, &neural::Anchors::new(&rows, &networks, finished.scene_scale));
    let deep: Vec<_> = spawned
        .gaussians
        .into_iter()
        .flatten()
        .map(|gaussian| twin::shade_depth(&projection, &gaussian))
        .collect();
    let twin = twin::forward(&projection, &deep, DVec3::ZERO, twin::Cutoffs::default());
    let (mut seen, mut empty) = (0, 0);
    for ((depth, alpha), pixel) in depth.values.iter().zip(&alpha.values).zip(&twin.frame.image) {
        let (depth, alpha) = (f64::from(*depth), f64::from(*alpha));
        let expected = 1.0 - pixel[3];
        // A contribution at 1/255 may be decided otherwise in f32; it weighs that much of the depth.
        assert!((alpha - expected).abs() < 0.005, "{alpha} {expected}");
        if alpha < f64::from(MIN_VISIBLE_ALPHA) {
            assert_eq!(depth, 0.0);
            empty += 1;
        } else if alpha > 0.1 {
            let expected = pixel[0] / expected;
            assert!((depth - expected).abs() < 0.05 * expected, "{depth} {expected}");
            if (alpha - (1.0 - pixel[3])).abs() < 1e-4 {
                assert!((depth - expected).abs() < 1e-3 * expected, "{depth} {expected}");
            }
            // The scene is about the origin, at distance four.
            assert!((2.0..6.0).contains(&depth), "{depth}");
            seen += 1;
        }
    }
    assert!(seen > 100 && empty > 10, "{seen} pixels see something, {empty} nothing");
    let image = renderer.render(&camera).expect("a view");
    let mut fresh = Renderer::new(&gpu(), &finished, Background::White).expect("a renderer");
    assert_eq!(fresh.render(&camera), Ok(image), "colors are what they are without depth before them");
}

#[test]
fn networks_of_another_depth_are_refused() {
    let (_, _, mut finished) = scene();
    finished.networks.color.layers.pop();
    let refused = Renderer::new(&gpu(), &finished, Background::Black).map(drop);
    assert!(matches!(refused, Err(RenderError::Scene(error)) if error.contains("layers")));
}

#[test]
fn widths_that_a_file_may_have_and_the_kernels_do_not_know_are_refused() {
    let wide = |features: usize, offsets: usize| {
        let (_, _, mut finished) = scene();
        let anchors = finished.len();
        finished.feature_dim = features;
        finished.features = vec![0.0; anchors * features];
        finished.offsets_per_anchor = offsets;
        finished.offsets = vec![0.0; anchors * offsets * 3];
        finished.masks = vec![true; anchors * offsets];
        Renderer::new(&gpu(), &finished, Background::Black).map(drop)
    };
    for (features, offsets, part) in [(4, 33, "33 offsets"), (4, 64, "64 offsets"), (0, 2, "no channels")] {
        let refused = wide(features, offsets);
        assert!(matches!(&refused, Err(RenderError::Scene(error)) if error.contains(part)), "{refused:?}");
    }
}

#[test]
fn views_stay_within_their_memory_and_scenes_used_before_make_room() {
    let (_, _, finished) = scene();
    let camera = random::camera(20, 20);
    let loads = Cell::new(0);
    let load = || {
        loads.set(loads.get() + 1);
        Ok(Viewable { scene: Scene::Anchors(finished.clone()), background: Background::Black })
    };
    let view = |viewer: &SceneViewer, name: &[u8]| viewer.render(Digest::of(name), &load, &camera);
    let free = SceneViewer::open(choice()).expect("an adapter");
    let image = view(&free, b"a").expect("a view");
    let one = free.peak_bytes();

    loads.set(0);
    let narrow = SceneViewer::within(choice(), one + one / 2).expect("an adapter");
    for (name, expected) in [(b"a", 1), (b"a", 1), (b"b", 2), (b"b", 2), (b"a", 3)] {
        assert_eq!(view(&narrow, name), Ok(image.clone()));
        assert_eq!(loads.get(), expected, "only one scene fits");
    }
    assert!(narrow.peak_bytes() <= one + one / 2);

    let short = SceneViewer::within(choice(), one / 2).expect("an adapter");
    for _ in 0..2 {
        let refused = view(&short, b"a").expect_err("no room");
        assert_eq!(refused.status, 507, "{refused}");
        assert!(refused.detail.contains("--view-memory"), "{refused}");
    }
}

#[test]
fn the_viewer_loads_a_scene_once_forgets_the_oldest_and_survives_a_lost_device() {
    let viewer = Arc::new(SceneViewer::open(choice()).expect("an adapter"));
    let (_, _, finished) = scene();
    let camera = random::camera(20, 20);
    let loads = Cell::new(0);
    let view = |name: &[u8]| {
        let load = || {
            loads.set(loads.get() + 1);
            Ok(Viewable { scene: Scene::Anchors(finished.clone()), background: Background::Black })
        };
        viewer.render(Digest::of(name), &load, &camera).expect("a view")
    };
    let first = view(b"a");
    assert_eq!((view(b"a"), loads.get()), (first.clone(), 1));
    for other in [b"b", b"c", b"d"] {
        view(other);
    }
    view(b"a");
    assert_eq!(loads.get(), 4, "four scenes are kept");
    view(b"e");
    view(b"a");
    assert_eq!(loads.get(), 5, "the latest used are");
    view(b"b");
    assert_eq!(loads.get(), 6, "the one not used for longest is not");

    viewer.destroy_device();
    assert_eq!(
        (view(b"a"), loads.get()),
        (first, 7),
        "the device is opened again and the scene loaded again"
    );
}

#[test]
fn a_hung_device_costs_one_view_and_is_opened_again_for_the_next() {
    let viewer = SceneViewer::open(choice()).expect("an adapter");
    let (_, _, finished) = scene();
    let camera = random::camera(20, 20);
    let loads = Cell::new(0);
    let load = || {
        loads.set(loads.get() + 1);
        Ok(Viewable { scene: Scene::Anchors(finished.clone()), background: Background::Black })
    };
    let view = || viewer.render(Digest::of(b"a"), &load, &camera);
    let first = view().expect("a view");
    viewer.hang_device();
    let error = view().expect_err("it does not answer");
    assert_eq!((error.status, &*error.kind), (503, "urn:tcgs:problem:device-timeout"), "{error:?}");
    assert_eq!(loads.get(), 1, "what made a device hang is not tried on the next");
    assert_eq!((view().expect("a view"), loads.get()), (first, 2));
}

#[test]
fn images_are_packed_as_the_twin_packs_them_with_the_counters_behind() {
    let device = gpu();
    let mut packed = PackedImage::new(&device).expect("a kernel");
    let levels = |pixel: usize| [0, 1, 2].map(|channel| ((3 * pixel + channel) * 37 % 1021) as f32 / 4.0);
    // Quarters of levels, so exact halves too, from below the range to beyond it; the buffers grow and shrink.
    for pixels in [1, 64, 1665, 7] {
        let image: Vec<[f32; 4]> = (0..pixels)
            .map(|pixel| {
                let [red, green, blue] = levels(pixel).map(|level| level / 255.0);
                if pixel % 5 == 0 { [-red, 1.0 + green, blue, 0.5] } else { [red, green, blue, 0.5] }
            })
            .collect();
        let counters: Vec<u32> = vec![7, 9, pixels as u32, u32::MAX];
        let on_device = device.upload("image", &image).expect("uploads");
        let counted = device.upload("counters", &counters).expect("uploads");
        let mut recorder = device.recorder("packing");
        packed.record(&device, &mut recorder, &on_device, &counted).expect("records");
        recorder.submit().expect("submits");
        let pending = packed.start_read(&device).expect("submits");
        let (samples, read) = packed.finish_read(&device, pending).expect("reads");
        assert_eq!(read, counters);
        assert_eq!(samples.len(), 3 * pixels);
        for (sample, value) in samples.iter().zip(image.iter().flat_map(|pixel| &pixel[..3])) {
            // The kernel's product is rounded to f32 before it is rounded to a level.
            let level = f64::from(value.clamp(0.0, 1.0) * 255.0);
            let [expected, ..] = twin::pack_image([level / 255.0; 3]);
            let halfway = (level.fract() - 0.5).abs() < 1e-9;
            assert!(
                *sample == expected || (halfway && f64::from(*sample) == level.ceil()),
                "{value}: {sample}"
            );
        }
    }
}
