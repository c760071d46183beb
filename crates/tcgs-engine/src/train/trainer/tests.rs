use glam::DVec3;
use rand::RngExt;

use super::{submission::MAX_SUBMISSION_MS, *};
use crate::{
    domain::{
        Camera, Digest, Image, Intrinsics, Layout, ModelKind, PointCloud, Pose, Preset,
        evenly_spaced::evenly_spaced,
    },
    gpu::testing::lavapipe,
    train::{CheckpointError, exposure::distance_of_mean},
};

/// Growth comes at step 25; noise after 5, the context model after 18, and everything is rounded after 46.
const STEPS: u32 = 54;

/// Photographs of noise around random points, each camera nearer than the one before.
fn dataset() -> Dataset {
    let mut rng = Pcg64::seed_from_u64(1);
    let frames = (0..7).map(|index| {
        let turn = f64::from(index);
        let away = 4.0 - 0.3 * turn;
        let pose =
            Pose::look_at(DVec3::new(away * turn.cos(), away * turn.sin(), 1.0), DVec3::ZERO, DVec3::Z);
        let intrinsics = Intrinsics { fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0, width: 64, height: 48 };
        let camera = Camera::new(intrinsics, pose.expect("a view")).expect("a camera");
        let samples = (0..64 * 48 * 3).map(|_| rng.random()).collect();
        let image = Image::new(64, 48, 3, samples).expect("an image");
        Frame { name: index.to_string(), camera, image: image.into(), mask: None, split: Split::Train }
    });
    let frames = frames.collect();
    let mut rng = Pcg64::seed_from_u64(2);
    let positions: Vec<[f64; 3]> = (0..60).map(|_| [0; 3].map(|_| rng.random_range(-1.0..1.0))).collect();
    Dataset {
        layout: Layout::Colmap,
        frames,
        points: Some(PointCloud { colors: vec![[0; 3]; positions.len()], positions }),
        digest: Digest::of(b"noise"),
        notes: Vec::new(),
    }
}

#[test]
fn neither_batches_nor_a_want_of_room_change_a_bit() {
    steps_are_the_same_in_batches_and_with_little_room(dataset());
}

#[test]
fn nor_do_they_where_points_are_random() {
    steps_are_the_same_in_batches_and_with_little_room(Dataset { points: None, ..dataset() });
}

fn steps_are_the_same_in_batches_and_with_little_room(dataset: Dataset) {
    let device = lavapipe();
    let options = TrainOptions { iterations: Some(STEPS), seed: 3, ..TrainOptions::default() };
    let run = |batch: usize, room: Option<usize>| {
        let budget = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
        let mut run = Run::new(&device, &dataset, &options, &budget, None).expect("begins");
        run.batch = Batch::Fixed(batch);
        if let Some(room) = room {
            run.raster.set_initial_capacity(room);
        }
        let (mut recorded, mut losses) = (0, Vec::new());
        while run.state.step < STEPS {
            recorded += run.advance(&mut |step| step % 9 == 8, &CancelFlag::default()).expect("steps");
            let reported = |report: Progress| {
                let Progress { step, loss, psnr, anchors, gaussians, bytes, .. } = report;
                (step, loss, psnr, anchors, gaussians, bytes)
            };
            losses.extend(run.news.drain(..).map(reported));
        }
        let Trained { scene, context, .. } = run.finish(&CancelFlag::default()).expect("a scene");
        (recorded, losses, (scene, context.expect("a context model")))
    };
    let (recorded, losses, scene) = run(1, None);
    assert_eq!(recorded, STEPS, "with room no step is done twice");
    for (batch, room) in [(1, Some(1)), (10, None), (10, Some(1)), (7, Some(20)), (4, Some(300))] {
        let (again, others, other) = run(batch, room);
        assert!(other == scene && others == losses, "batches of {batch} with room for {room:?}");
        assert_eq!(again > STEPS, room.is_some(), "{again} steps recorded with room for {room:?}");
    }
}

#[test]
fn looking_at_the_model_changes_no_bit() {
    let device = lavapipe();
    let options = TrainOptions { iterations: Some(STEPS), seed: 3, ..TrainOptions::default() };
    let budget = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
    for dataset in [dataset(), Dataset { points: None, ..dataset() }] {
        let run = |is_watched: bool| {
            let mut run = Run::new(&device, &dataset, &options, &budget, None).expect("begins");
            if is_watched {
                run.monitor = Some(Monitor::new(&device, &dataset, run.frame, options.background));
            }
            let mut seen = Vec::new();
            while run.state.step < STEPS {
                run.advance(&mut |_| true, &CancelFlag::default()).expect("steps");
                if is_watched {
                    // With time for every look.
                    let monitor = run.monitor.take().expect("a monitor");
                    run.monitor = Some(monitor.with_time());
                    run.look().expect("a look");
                }
                seen.extend(std::mem::take(&mut run.news).into_iter().map(|news| run.as_seen(news)));
            }
            (seen, run.finish(&CancelFlag::default()).expect("a scene"))
        };
        let ((alone, scene), (watched, same)) = (run(false), run(true));
        assert!(scene.scene == same.scene && scene.context == same.context);
        assert!(alone.iter().all(|report| report.preview.is_none()));
        for (alone, watched) in alone.iter().zip(&watched) {
            assert_eq!(
                (alone.loss, alone.anchors, alone.bytes),
                (watched.loss, watched.anchors, watched.bytes)
            );
            let preview = watched.preview.as_ref().expect("a preview");
            assert_eq!((preview.render.width(), preview.render.height()), (64, 48));
            assert_eq!(preview.photograph.width(), 64);
        }
        // The last one is that of the finished scene, before it is written.
        let mut renderer =
            crate::render::Renderer::of_scene(&device, &scene.scene, options.background).expect("a scene");
        let frames: Vec<&Frame> = evenly_spaced(&dataset.frames, 4).collect();
        let psnr = frames.iter().map(|frame| {
            let target = crate::eval::Target::of(frame, options.background).expect("readable");
            target.psnr(&renderer.render(&frame.camera).expect("rendered")).expect("a figure")
        });
        let result = psnr.sum::<f64>() / frames.len() as f64;
        let last = watched.last().and_then(|report| report.psnr).expect("a figure");
        assert!((last - result).abs() < 0.05, "{last} dB at the end of training, {result} dB of the result");
    }
}

#[test]
fn the_figures_of_a_step_are_one_transfer() {
    let (device, dataset) = (lavapipe(), dataset());
    let options = TrainOptions { iterations: Some(STEPS), seed: 3, ..TrainOptions::default() };
    let budget = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
    let mut run = Run::new(&device, &dataset, &options, &budget, None).expect("begins");
    while run.state.step < STEPS / 2 {
        run.advance(&mut |_| false, &CancelFlag::default()).expect("steps");
    }
    let made = device.buffers_made();
    let figures = run.read_figures().expect("read");
    assert!(figures.bits.is_some(), "the context model learns");
    run.take_figures(run.state.step, &figures).expect("weighed");
    assert_eq!(device.buffers_made() - made, 1);
}

/// A model that has just been replaced, by anchors or by one with fewer channels, has rendered nothing yet.
#[test]
fn every_report_counts_gaussians() {
    let device = lavapipe();
    let options = TrainOptions { iterations: Some(STEPS), seed: 3, ..TrainOptions::default() };
    let budget = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
    for dataset in [dataset(), Dataset { points: None, ..dataset() }] {
        let mut run = Run::new(&device, &dataset, &options, &budget, None).expect("begins");
        run.batch = Batch::Fixed(1);
        while run.state.step < STEPS {
            run.advance(&mut |_| true, &CancelFlag::default()).expect("steps");
            let figures = run.read_figures().expect("read");
            let Progress { step, gaussians, .. } = run.progress(run.state.step, &figures);
            assert!(gaussians > 0, "step {step}");
        }
    }
}

#[test]
fn the_choice_of_a_context_model_does_not_keep_a_cancelled_run_waiting() {
    let (device, dataset) = (lavapipe(), dataset());
    let options = TrainOptions { iterations: Some(STEPS), seed: 3, ..TrainOptions::default() };
    let budget = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
    let mut run = Run::new(&device, &dataset, &options, &budget, None).expect("begins");
    let cancelled = CancelFlag::default();
    cancelled.cancel();
    let ended = loop {
        match run.advance(&mut |_| true, &cancelled) {
            Ok(_) => assert!(run.state.step < STEPS, "models were fitted to their end"),
            Err(error) => break error,
        }
    };
    assert!(matches!(ended, TrainError::Cancelled), "{ended}");
    assert!(run.state.step > STEPS / 2, "single steps are not asked");
}

/// Keeps the last checkpoint, and cancels the run while a step is under way.
struct CancelAfter<'a> {
    step: u32,
    flag: &'a CancelFlag,
    saved: Option<Checkpoint>,
}

impl CheckpointSink for CancelAfter<'_> {
    fn wants(&mut self, step: u32) -> bool {
        if step == self.step {
            self.flag.cancel();
        }
        false
    }

    fn save(&mut self, checkpoint: &Checkpoint) -> std::result::Result<(), CheckpointError> {
        let mut bytes = Vec::new();
        checkpoint.write(&mut bytes).expect("memory takes it");
        self.saved = Some(Checkpoint::from_bytes(&bytes).expect("read"));
        Ok(())
    }
}

#[test]
fn no_step_is_lost_of_a_run_that_is_cancelled_whenever_it_is() {
    let (device, dataset) = (lavapipe(), dataset());
    let options =
        TrainOptions { iterations: Some(STEPS), seed: 3, max_bytes: Some(6_000), ..TrainOptions::default() };
    let budget = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
    let begin = |resume| {
        let mut run = Run::new(&device, &dataset, &options, &budget, resume).expect("begins");
        run.batch = Batch::Fixed(8);
        run
    };
    let finished = |mut run: Run| {
        run.run_until(Goal::End, None, &mut |_| (), &CancelFlag::default()).expect("ends");
        run.finish(&CancelFlag::default()).expect("a scene").scene
    };
    let whole = begin(None);
    let pauses: Vec<u32> = (1..STEPS).filter(|step| whole.schedule.pauses_after(*step)).collect();
    assert!(pauses.len() > 2, "{pauses:?}");
    let mut resumed: Option<Checkpoint> = None;
    for step in 1..STEPS {
        if resumed.as_ref().is_some_and(|checkpoint| checkpoint.step() >= step) {
            continue;
        }
        let flag = CancelFlag::default();
        let mut sink = CancelAfter { step, flag: &flag, saved: None };
        let ended = begin(resumed.take()).run_until(Goal::End, Some(&mut sink), &mut |_| (), &flag);
        // The last batch ends the run.
        assert!(matches!(ended, Ok(()) | Err(TrainError::Cancelled)), "{step}: {ended:?}");
        let saved = sink.saved.expect("a checkpoint");
        assert!(saved.step() >= step, "cancelled after step {step} of which {} are kept", saved.step());
        resumed = Some(saved);
    }
    assert!(finished(begin(resumed)) == finished(whole), "another scene");
}

#[test]
fn a_run_from_random_points_goes_on_from_either_of_its_stages() {
    let (device, dataset) = (lavapipe(), Dataset { points: None, ..dataset() });
    let budget = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
    for model in [ModelKind::Tcgs, ModelKind::Scaffold] {
        let options = TrainOptions { model, iterations: Some(STEPS), seed: 3, ..TrainOptions::default() };
        let begin = |resume| Run::new(&device, &dataset, &options, &budget, resume).expect("begins");
        let run_to = |run: &mut Run, last: u32| {
            while run.state.step < last {
                run.advance(&mut |step| step == last, &CancelFlag::default()).expect("steps");
            }
        };
        let until = begin(None).schedule.plain_until;
        assert_eq!(until, 11);
        let mut whole = begin(None);
        let mut kept = Vec::new();
        for step in [5, until - 1, until, until + 1, 30] {
            run_to(&mut whole, step);
            assert_eq!(whole.model.anchors() > 0, step >= until, "anchors after step {step}");
            let mut bytes = Vec::new();
            whole.checkpoint().expect("state").write(&mut bytes).expect("memory takes it");
            kept.push((step, Checkpoint::from_bytes(&bytes).expect("read")));
        }
        run_to(&mut whole, STEPS);
        let scene = whole.finish(&CancelFlag::default()).expect("a scene").scene;
        assert!(scene.as_anchors().is_some());
        for (step, checkpoint) in kept {
            let mut resumed = begin(Some(checkpoint));
            run_to(&mut resumed, STEPS);
            let other = resumed.finish(&CancelFlag::default()).expect("a scene").scene;
            assert!(other == scene, "{model}: another scene after step {step}");
        }
    }
}

#[test]
fn no_part_of_a_long_step_is_too_long_for_a_slow_card() {
    // Milliseconds for a Gaussian of the longest part, the rasterizer's backward pass: `raster_backward`, `gather` and
    // `project_backward` (docs/HARDWARE.md).
    const MS_A_GAUSSIAN_BACKWARD: f64 = 2.4e-6;
    for preset in Preset::ALL {
        for model in ModelKind::ALL {
            let schedule = Schedule::new(&TrainOptions { preset, model, ..TrainOptions::default() });
            let gaussians = match model {
                ModelKind::Gaussians3d => schedule.max_size(),
                ModelKind::Tcgs | ModelKind::Scaffold => schedule.max_size() * schedule.shape.offsets,
            };
            let longest = MS_A_GAUSSIAN_BACKWARD * gaussians as f64;
            assert!(longest <= MAX_SUBMISSION_MS, "{preset} {model}: {longest} ms for {gaussians} Gaussians");
        }
    }
}

#[test]
fn color_corrections_keep_their_mean_and_go_on_from_any_step_with_the_same_bits() {
    let (device, dataset) = (lavapipe(), dataset());
    let budget = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
    for model in ModelKind::ALL {
        let exposure = Exposure::On;
        let options =
            TrainOptions { model, exposure, iterations: Some(STEPS), seed: 3, ..TrainOptions::default() };
        let begin = |resume| Run::new(&device, &dataset, &options, &budget, resume).expect("begins");
        let run_to = |run: &mut Run, last: u32| {
            while run.state.step < last {
                run.advance(&mut |step| step == last, &CancelFlag::default()).expect("steps");
            }
        };
        let corrections = |run: &Run| run.corrections.as_ref().expect("corrections").read().expect("read");
        let mut whole = begin(None);
        let mut kept = Vec::new();
        for step in [3, 20, 49] {
            run_to(&mut whole, step);
            let now = corrections(&whole);
            assert_eq!(now.len(), 7);
            assert!(distance_of_mean(&now) < 1e-6, "{model} {step}: {}", distance_of_mean(&now));
            let mut bytes = Vec::new();
            whole.checkpoint().expect("state").write(&mut bytes).expect("memory takes it");
            kept.push((step, Checkpoint::from_bytes(&bytes).expect("read")));
        }
        run_to(&mut whole, STEPS);
        let learnt = corrections(&whole);
        assert!(learnt[0] != learnt[1], "{learnt:?}");
        let scene = whole.finish(&CancelFlag::default()).expect("a scene").scene;
        for (step, checkpoint) in kept {
            assert_eq!(checkpoint.exposure(), ExposureChoice::ON);
            let mut resumed = begin(Some(checkpoint));
            // Overflows repeat steps, and longer batches have more of them in flight.
            resumed.batch = Batch::Fixed(10);
            resumed.raster.set_initial_capacity(1);
            run_to(&mut resumed, STEPS);
            assert!(corrections(&resumed) == learnt, "{model}: other corrections after step {step}");
            let other = resumed.finish(&CancelFlag::default()).expect("a scene").scene;
            assert!(other == scene, "{model}: another scene after step {step}");
        }
    }
}
