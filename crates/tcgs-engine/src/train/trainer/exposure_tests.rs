//! Runs on photographs of one scene whose exposures differ, and on the same photographs without.

use glam::DVec3;
use rand::RngExt;

use super::*;
use crate::{
    domain::{
        Camera, ColorFitScores, Digest, Image, Intrinsics, Layout, ModelKind, PixelMask, PointCloud, Pose,
        evenly_spaced::evenly_spaced,
    },
    eval::{ViewMeasurement, mean_color_fit},
    gpu::testing::lavapipe,
    render::{
        Projection, RenderError, Renderer,
        twin::{self, Gaussian},
    },
};

const SIZE: [u32; 2] = [40, 32];

/// Views on two circles around the scene; every eighth is held out.
const VIEWS: u32 = 18;

/// Opaque Gaussians of random colors on a floor and in a heap above it.
fn gaussians() -> Vec<Gaussian> {
    let mut rng = Pcg64::seed_from_u64(4);
    (0..60)
        .map(|index| {
            let mut between = |low: f64, high: f64| rng.random_range(low..high);
            let is_floor = index < 30;
            let reach = if is_floor { 1.6 } else { 0.7 };
            let height = if is_floor { between(-0.65, -0.55) } else { between(-0.5, 0.7) };
            let scale = between(0.15, 0.3);
            Gaussian {
                mean: DVec3::new(between(-reach, reach), between(-reach, reach), height),
                opacity: 0.97,
                scale: DVec3::new(scale, scale, if is_floor { 0.08 } else { scale }),
                quat: [1.0, 0.0, 0.0, 0.0],
                color: DVec3::new(between(0.1, 0.7), between(0.1, 0.7), between(0.1, 0.7)),
            }
        })
        .collect()
}

fn camera(index: u32) -> Camera {
    let angle = f64::from(index) * std::f64::consts::TAU / f64::from(VIEWS);
    let position = DVec3::new(3.2 * angle.cos(), 3.2 * angle.sin(), 1.2 + f64::from(index % 2));
    let pose = Pose::look_at(position, DVec3::ZERO, DVec3::Z).expect("a view");
    let [width, height] = SIZE;
    let intrinsics = Intrinsics { fx: 44.0, fy: 44.0, cx: 20.0, cy: 16.0, width, height };
    Camera::new(intrinsics, pose).expect("a camera")
}

pub(super) fn is_held_out(index: u32) -> bool {
    index.is_multiple_of(8)
}

/// A gain for each channel of each view, whose mean over the training views is 1.
pub(super) fn gains() -> Vec<DVec3> {
    let mut rng = Pcg64::seed_from_u64(6);
    let mut gain = || {
        let exposure = rng.random_range(0.55..1.3);
        DVec3::from([0; 3].map(|_| exposure * rng.random_range(0.9..1.1)))
    };
    let gains: Vec<DVec3> = (0..VIEWS).map(|_| gain()).collect();
    let trained = || (0..VIEWS).filter(|index| !is_held_out(*index)).map(|index| gains[index as usize]);
    let mean = trained().sum::<DVec3>() / trained().count() as f64;
    gains.iter().map(|gain| gain / mean).collect()
}

fn photograph(camera: &Camera, gain: DVec3) -> Image {
    let projection = Projection::new(camera, &RasterSettings::default());
    let rendering = twin::forward(&projection, &gaussians(), DVec3::ZERO, twin::Cutoffs::default());
    let pixels = rendering.frame.image.iter().flat_map(|p| (gain * DVec3::new(p[0], p[1], p[2])).to_array());
    let samples = pixels.map(|value| (value.clamp(0.0, 1.0) * 255.0).round() as u8);
    Image::new(SIZE[0], SIZE[1], 3, samples.collect()).expect("an image")
}

/// Photographs multiplied by `gains`.
pub(super) fn dataset(gains: &[DVec3]) -> Dataset {
    let frames = (0..VIEWS).map(|index| {
        let camera = camera(index);
        Frame {
            name: format!("{index:02}"),
            camera,
            image: photograph(&camera, gains[index as usize]).into(),
            mask: None,
            split: if is_held_out(index) { Split::Test } else { Split::Train },
        }
    });
    let mut rng = Pcg64::seed_from_u64(1);
    let positions: Vec<[f64; 3]> = gaussians()
        .iter()
        .flat_map(|gaussian| [gaussian; 3])
        .map(|gaussian| {
            let away = DVec3::from([0; 3].map(|_| rng.random_range(-0.8..0.8)));
            (gaussian.mean + gaussian.scale * away).to_array()
        })
        .collect();
    Dataset {
        layout: Layout::Colmap,
        frames: frames.collect(),
        points: Some(PointCloud { colors: vec![[90; 3]; positions.len()], positions }),
        digest: Digest::of(b"exposures"),
        notes: Vec::new(),
    }
}

pub(super) fn clean() -> Dataset {
    dataset(&[DVec3::ONE; VIEWS as usize])
}

pub(super) fn options(model: ModelKind, steps: u32, exposure: Exposure) -> TrainOptions {
    TrainOptions { model, exposure, iterations: Some(steps), seed: 2, ..TrainOptions::default() }
}

pub(super) fn run(dataset: &Dataset, options: &TrainOptions) -> Trained {
    Trainer::new(&lavapipe(), dataset, options).run(|_| ()).expect("a scene")
}

fn color_fit(trained: &Trained, dataset: &Dataset) -> ColorFitScores {
    let background = Background::Black;
    let renderer = &mut Renderer::of_scene(&lavapipe(), &trained.scene, background).expect("a renderer");
    let before_each: &mut dyn FnMut() -> Result<(), RenderError> = &mut || Ok(());
    let measurement = ViewMeasurement { renderer, background, before_each };
    let frames: Vec<&Frame> = dataset.split(Split::Test).collect();
    let (_, halves) = measurement.scores_with_halves(&frames, None).expect("measured");
    mean_color_fit(&halves).expect("held-out views")
}

/// The mean color of the scene's views over that of the photographs without gains, by channel.
fn tint(trained: &Trained, clean: &Dataset) -> DVec3 {
    let mut renderer =
        Renderer::of_scene(&lavapipe(), &trained.scene, Background::Black).expect("a renderer");
    let sum = |image: &Image| -> DVec3 {
        let pixels = image.samples().chunks_exact(3);
        pixels.map(|p| DVec3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]))).sum()
    };
    let (mut found, mut expected) = (DVec3::ZERO, DVec3::ZERO);
    for frame in &clean.frames {
        found += sum(&renderer.render(&frame.camera).expect("a view"));
        expected += sum(&frame.image.load().expect("in memory"));
    }
    found / expected
}

/// How far corrections of the training photographs, in their order, are from the gains of these for a gray color.
fn worst_gain(corrections: &[ColorFit]) -> f64 {
    let trained: Vec<DVec3> =
        (0..VIEWS).filter(|index| !is_held_out(*index)).map(|index| gains()[index as usize]).collect();
    assert_eq!(corrections.len(), trained.len());
    let found = corrections.iter().map(|fit| DVec3::from(fit.corrected([0.4; 3]).map(f64::from)) / 0.4);
    let errors = found.zip(trained).map(|(found, expected)| (found - expected).abs().max_element());
    errors.fold(0.0, f64::max)
}

#[test]
fn corrections_make_up_for_exposures_and_leave_the_scene_without_tint() {
    let (exposed, clean) = (dataset(&gains()), clean());
    for model in [ModelKind::Tcgs, ModelKind::Gaussians3d] {
        let [on, off] = [Exposure::On, Exposure::Off].map(|exposure| {
            let trained = run(&exposed, &options(model, 300, exposure));
            assert_eq!(trained.exposure.corrected, exposure == Exposure::On);
            assert_eq!(trained.choices.exposure, None, "the option decided");
            assert_eq!(trained.corrections.is_some(), exposure == Exposure::On);
            if let Some(corrections) = &trained.corrections {
                assert!(
                    worst_gain(corrections) < 0.2,
                    "{model}: gains are off by {}",
                    worst_gain(corrections)
                );
            }
            (color_fit(&trained, &exposed).corrected_psnr, tint(&trained, &clean))
        });
        println!("{model}: {on:?} with corrections, {off:?} without");
        assert!(on.0 > off.0 + 1.0, "{model}: {} dB with corrections, {} without", on.0, off.0);
        assert!((on.1 - DVec3::ONE).abs().max_element() < 0.02, "{model}: a tint of {}", on.1);
    }
}

fn chosen(dataset: &Dataset, options: &TrainOptions) -> ExposureChoice {
    let (device, cancel) = (lavapipe(), CancelFlag::default());
    let train: &ShortRun<'_> =
        &|dataset, options, report| Trainer::new(&device, dataset, options).run(report);
    let trial = Trial { device: &device, dataset, options, cancel: &cancel, train };
    choose(&trial, &mut |progress: &Progress| assert_eq!(progress.step, 0)).expect("chosen")
}

#[test]
fn auto_has_the_bits_of_on_where_exposures_differ_and_those_of_off_where_they_do_not() {
    let all = [(dataset(&gains()), Exposure::On), (clean(), Exposure::Off)];
    for (dataset, decision) in all {
        let with = |exposure| run(&dataset, &options(ModelKind::Gaussians3d, 500, exposure));
        let (auto, decided) = (with(Exposure::Auto), with(decision));
        let trial = auto.exposure.trial.expect("a trial");
        println!("{decision}: {trial:?}");
        assert_eq!(auto.exposure.corrected, decision == Exposure::On, "{trial:?}");
        assert_eq!((trial.views, decided.exposure.trial), (2, None));
        assert_eq!(auto.choices.exposure, auto.exposure.corrected.then_some(trial));
        assert!(auto.scene == decided.scene, "{decision}: other bits");
    }
}

#[test]
fn the_trial_of_an_anchor_model_decides_likewise() {
    let options = options(ModelKind::Tcgs, 500, Exposure::Auto);
    let [exposed, clean] = [dataset(&gains()), clean()].map(|dataset| chosen(&dataset, &options));
    println!("{exposed:?} {clean:?}");
    assert!(exposed.corrected && !clean.corrected, "{exposed:?} {clean:?}");
}

#[test]
fn held_out_views_have_no_part_in_the_trial() {
    let options = options(ModelKind::Gaussians3d, 500, Exposure::Auto);
    let whole = dataset(&gains());
    let mut other = whole.clone();
    let black = Image::new(SIZE[0], SIZE[1], 3, vec![0; 3 * (SIZE[0] * SIZE[1]) as usize]).expect("an image");
    let held_out = other.frames.iter_mut().filter(|frame| frame.split == Split::Test);
    held_out.for_each(|frame| frame.image = black.clone().into());
    assert_eq!(chosen(&whole, &options), chosen(&other, &options));
}

#[test]
fn views_of_which_a_mask_hides_one_half_have_no_part_in_the_decision() {
    let options = options(ModelKind::Gaussians3d, 500, Exposure::Auto);
    let mut exposed = dataset(&gains());
    let train: Vec<&Frame> = exposed.split(Split::Train).collect();
    let aside: Vec<String> = evenly_spaced(&train, 2).map(|frame| frame.name.clone()).collect();
    let [width, height] = SIZE;
    let mut hide = |name: &str, hidden: std::ops::Range<u32>| {
        let frame = exposed.frames.iter_mut().find(|frame| frame.name == name).expect("a view");
        frame.mask = Some(PixelMask::from_fn(width, height, |x, _| !hidden.contains(&x)));
        exposed.clone()
    };
    let one = hide(&aside[0], width / 2..width);
    let both = hide(&aside[1], 0..width / 2);
    let choice = chosen(&one, &options);
    assert_eq!((choice.corrected, choice.trial.map(|trial| trial.views)), (true, Some(1)), "{choice:?}");
    assert_eq!(chosen(&both, &options), ExposureChoice::OFF);
}

#[test]
fn what_is_no_set_of_photographs_or_too_short_a_run_has_no_trial() {
    let auto = |steps| options(ModelKind::Gaussians3d, steps, Exposure::Auto);
    let exposed = dataset(&gains());
    let blender = Dataset { layout: Layout::Blender, ..exposed.clone() };
    let mut few = exposed.clone();
    few.frames.truncate(6);
    let mut clear = exposed.clone();
    let samples = vec![128; 4 * (SIZE[0] * SIZE[1]) as usize];
    clear.frames[5].image = Image::new(SIZE[0], SIZE[1], 4, samples).expect("an image").into();
    for (dataset, steps) in [(&exposed, 499), (&blender, 2000), (&few, 2000), (&clear, 2000)] {
        assert_eq!(chosen(dataset, &auto(steps)), ExposureChoice::OFF, "{steps} steps");
    }
    assert_eq!(chosen(&blender, &options(ModelKind::Tcgs, 10, Exposure::On)), ExposureChoice::ON);
    assert_eq!(chosen(&exposed, &options(ModelKind::Tcgs, 900, Exposure::Off)), ExposureChoice::OFF);
}

#[test]
fn a_cancelled_run_ends_in_its_trial() {
    let (exposed, cancel) = (dataset(&gains()), CancelFlag::default());
    cancel.cancel();
    let (device, options) = (lavapipe(), options(ModelKind::Gaussians3d, 500, Exposure::Auto));
    let ended = Trainer::new(&device, &exposed, &options).cancelled_by(&cancel).run(|_| ());
    assert!(matches!(ended, Err(TrainError::Cancelled)), "{ended:?}");
}
