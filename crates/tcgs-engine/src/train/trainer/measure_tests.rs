//! What training views lose is measured as the loss sees them: through their color corrections, and over the pixels that count.

use super::{
    exposure_tests::{clean, dataset, gains, is_held_out, options, run},
    *,
};
use crate::{
    domain::{AnchorScene, Image, ModelKind, PixelMask},
    eval::{RemovalCosts, TrainView, mean_psnr, removal_costs},
    gpu::testing::lavapipe,
    model::{AnchorRows, NetworkLayout},
    render::{AnchorGradients, CorrectionRows, DeviceAnchors, NeuralGaussians, Renderer},
    train::{checkpoint::ModelState, removal_losses::removal_losses, sensitivity::feature_sensitivity},
};

const IDENTITY: CorrectionRows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// Makes every color gray: no Gaussian matters.
const GRAY: CorrectionRows = [[0.0, 0.0, 0.0, 0.5]; 3];

fn begun(dataset: &Dataset, options: &TrainOptions) -> Run {
    let budget = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
    Run::new(&lavapipe(), dataset, options, &budget, None).expect("begins")
}

fn anchors(dataset: &Dataset) -> AnchorScene {
    match run(dataset, &options(ModelKind::Scaffold, 60, Exposure::Off)).scene {
        Scene::Anchors(scene) => scene,
        Scene::Gaussians(_) => panic!("a scene of anchors"),
    }
}

fn correct_all(run: &Run, rows: CorrectionRows) {
    let values = vec![rows; run.frames.len()].concat().concat();
    let mut state = ModelState::default();
    state.put("corrections.first", vec![0.0_f32; values.len()]);
    state.put("corrections.second", vec![0.0_f32; values.len()]);
    state.put("corrections", values);
    run.corrections.as_ref().expect("corrections").restore(&mut state).expect("restored");
}

#[test]
fn gaussians_are_pruned_by_the_error_of_corrected_renders() {
    let mut run = begun(&dataset(&gains()), &options(ModelKind::Gaussians3d, 300, Exposure::On));
    let (step, device) = (run.at(1), Arc::clone(&run.device));
    let mut losses = |rows: CorrectionRows| {
        correct_all(&run, rows);
        let cancel = CancelFlag::default();
        let (model, _, mut views) = run.model_and_views(&cancel);
        removal_losses(model, &device, &step, &mut views).expect("measured")
    };
    let seen = losses(IDENTITY);
    assert!(seen.iter().filter(|loss| **loss != 0.0).count() > 20, "{seen:?}");
    assert!(losses(GRAY).iter().all(|loss| *loss == 0.0));
    // Against a photograph that is darker than every pixel, each Gaussian counts by its light alone.
    let bright = losses([[1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 2.0], [0.0, 0.0, 1.0, 2.0]]);
    let half = losses([[0.5, 0.0, 0.0, 2.0], [0.0, 0.5, 0.0, 2.0], [0.0, 0.0, 0.5, 2.0]]);
    for (half, bright) in half.iter().zip(&bright) {
        assert!((2.0 * half - bright).abs() < 1e-4 * (1e-3 + bright.abs()), "{half} {bright}");
    }
}

fn costs(scene: &AnchorScene, views: &[TrainView<'_>]) -> RemovalCosts {
    removal_costs(&lavapipe(), scene, views, Background::Black, &mut || true).expect("measured")
}

fn train_frames(dataset: &Dataset) -> impl Iterator<Item = &Frame> {
    dataset.split(Split::Train).take(4)
}

#[test]
fn removal_costs_are_those_of_corrected_renders() {
    let clean = clean();
    let scene = anchors(&clean);
    let corrected = |rows: Option<CorrectionRows>| {
        let correction = rows.map(ColorFit::from);
        let views: Vec<_> = train_frames(&clean).map(|frame| TrainView { frame, correction }).collect();
        costs(&scene, &views)
    };
    let plain = corrected(None);
    assert!(plain.anchors.iter().any(|cost| *cost > 0.1), "something costs: {plain:?}");
    assert_eq!(corrected(Some(IDENTITY)), plain);
    let RemovalCosts { offsets, anchors } = corrected(Some(GRAY));
    assert!(offsets.iter().chain(&anchors).all(|cost| *cost == 0.0));
}

#[test]
fn removal_costs_do_not_depend_on_pixels_that_do_not_count() {
    let clean = clean();
    let scene = anchors(&clean);
    let costs_of = |right: Option<u8>, mask: bool| {
        let mut changed = clean.clone();
        for frame in &mut changed.frames {
            let image = frame.image.load().expect("in memory");
            let (width, height) = (image.width(), image.height());
            let is_left = |index: usize| index / 3 % (width as usize) < width as usize / 2;
            let samples = image.samples().iter().enumerate();
            let samples =
                samples.map(|(index, value)| if is_left(index) { *value } else { right.unwrap_or(*value) });
            frame.image = Image::new(width, height, 3, samples.collect()).expect("an image").into();
            frame.mask = mask.then(|| PixelMask::from_fn(width, height, |x, _| x < width / 2));
        }
        let views: Vec<TrainView<'_>> = train_frames(&changed).map(TrainView::from).collect();
        costs(&scene, &views)
    };
    let masked = costs_of(None, true);
    assert!(masked.anchors.iter().any(|cost| *cost > 0.1), "something costs: {masked:?}");
    assert_ne!(masked, costs_of(None, false));
    for right in [0, 255] {
        assert_eq!(costs_of(Some(right), true), masked);
    }
}

#[test]
fn views_of_other_exposures_are_measured_through_their_corrections() {
    let (exposed, gains) = (dataset(&gains()), gains());
    let scene = Scene::Anchors(anchors(&clean()));
    let mut renderer = Renderer::of_scene(&lavapipe(), &scene, Background::Black).expect("a renderer");
    let correction = |index: usize| {
        let gain = gains[index].as_vec3();
        ColorFit::from([[gain.x, 0.0, 0.0, 0.0], [0.0, gain.y, 0.0, 0.0], [0.0, 0.0, gain.z, 0.0]])
    };
    let frames = || exposed.frames.iter().enumerate().filter(|(index, _)| !is_held_out(*index as u32));
    let plain: Vec<_> = frames().map(|(_, frame)| TrainView::from(frame)).collect();
    let corrected: Vec<_> =
        frames().map(|(index, frame)| TrainView { frame, correction: Some(correction(index)) }).collect();
    let mut psnr =
        |views: &[TrainView<'_>]| mean_psnr(&mut renderer, views, Background::Black).expect("measured");
    let (plain, corrected) = (psnr(&plain), psnr(&corrected));
    assert!(corrected > plain + 1.0, "{corrected} dB with corrections, {plain} without");
}

#[test]
fn features_matter_where_pixels_count_and_through_corrections() {
    let dataset = dataset(&gains());
    let scene = anchors(&dataset);
    let mut run = begun(&dataset, &options(ModelKind::Scaffold, 60, Exposure::On));
    let (device, shape) = (Arc::clone(&run.device), ModelShape::of(&scene));
    let rows = AnchorRows::from_scene(&scene);
    let networks = NetworkLayout::new(shape).from_networks(&scene.networks).expect("networks");
    let anchors = DeviceAnchors::upload(&device, &rows, &networks).expect("room");
    let gradients = AnchorGradients::plan(shape, rows.len()).make(&device).expect("room");
    let (near, scale) = (scene.near.depth(), scene.scene_scale);
    let mut neural = NeuralGaussians::new(Arc::clone(&device), shape, near, scale).expect("kernels");
    let mut products = |corrections: CorrectionRows, columns: Option<u32>| {
        correct_all(&run, corrections);
        for frame in &mut run.frames {
            let size = frame.camera.intrinsics;
            frame.mask =
                columns.map(|columns| PixelMask::from_fn(size.width, size.height, |x, _| x < columns));
        }
        let cancel = CancelFlag::default();
        let (_, _, mut views) = run.model_and_views(&cancel);
        feature_sensitivity(&device, &mut neural, &anchors, &gradients, &mut views).expect("measured")
    };
    let all = products(IDENTITY, None);
    assert!(all.iter().any(|product| *product != 0.0));
    assert_eq!(products(IDENTITY, Some(40)), all);
    assert_ne!(products(IDENTITY, Some(20)), all);
    assert!(products(IDENTITY, Some(0)).iter().all(|product| *product == 0.0));
    assert!(products(GRAY, None).iter().all(|product| *product == 0.0));
}
