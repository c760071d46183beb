//! The step loop: one photograph a step, forward, losses, backward, optimiser, and now and then growth and pruning.

use std::{sync::Arc, time::Instant};

use rand::{SeedableRng, seq::SliceRandom};
use rand_pcg::Pcg64;

use super::{
    Estimate, ImageLoss, LossSums, Needs, Schedule, TrainError, WaveletWeights,
    anchors::AnchorLearner,
    learner::{Learner, Step},
    loss::pack,
    plain::{PlainLearner, PlainSchedule},
    start_box::start_box,
};
use crate::{
    domain::{
        Background, CancelFlag, Component, Dataset, Frame, MemoryBudget, ModelKind, Progress, Scene, Split,
        TrainOptions,
    },
    gpu::Context,
    model::random_points,
    render::{RasterSettings, Rasterizer},
};

/// Steps between two reports of progress.
const REPORT_EVERY: u32 = 10;

/// A finished training run.
#[derive(Debug, Clone)]
pub struct Trained {
    /// The scene, not yet quantised.
    pub scene: Scene,
    /// Steps done.
    pub steps: u32,
    /// Seconds of training.
    pub seconds: f64,
}

/// Trains a scene on the dataset's training frames.
///
/// `report` is called every few steps. The run is a function of dataset, options and adapter.
///
/// # Errors
/// [`TrainError`]; a cancelled run ends as [`TrainError::Cancelled`] within a step, or within a view
/// of the pass that ends it.
pub fn train(
    context: &Arc<Context>,
    dataset: &Dataset,
    options: &TrainOptions,
    report: &mut dyn FnMut(&Progress),
    cancel: &CancelFlag,
) -> Result<Trained, TrainError> {
    let budget = MemoryBudget { host: u64::MAX, gpu: context.budget_bytes() };
    train_within(context, dataset, options, &budget, report, cancel)
}

/// As [`train`], growing no further than `budget` allows.
///
/// # Errors
/// As [`train`], and [`TrainError::OverBudget`] before anything is done.
pub fn train_within(
    context: &Arc<Context>,
    dataset: &Dataset,
    options: &TrainOptions,
    budget: &MemoryBudget,
    report: &mut dyn FnMut(&Progress),
    cancel: &CancelFlag,
) -> Result<Trained, TrainError> {
    let mut run = Run::begin(context, dataset, options, budget)?;
    for number in 1..=run.steps {
        if cancel.is_cancelled() {
            return Err(TrainError::Cancelled);
        }
        run.step(number)?;
        if number.is_multiple_of(REPORT_EVERY) || number == run.steps {
            report(&run.progress(number)?);
        }
    }
    run.finish(cancel)
}

/// 1.1 times the largest distance of a training camera from their mean: the scene's extent.
fn camera_extent(frames: &[&Frame]) -> f32 {
    let centers: Vec<_> = frames.iter().map(|frame| frame.camera.pose.center()).collect();
    let mean = centers.iter().sum::<glam::DVec3>() / centers.len().max(1) as f64;
    let radius = centers.iter().map(|center| center.distance(mean)).fold(0.0, f64::max);
    // A single camera has no radius; its distance unit is as good as any.
    if radius > 0.0 { (1.1 * radius) as f32 } else { 1.0 }
}

/// What growth may reach: the schedule's, or what memory has room for.
fn cap(wanted: usize, estimate: &Estimate) -> usize {
    if estimate.size < wanted {
        tracing::warn!(
            "growth stops at {} {} instead of {wanted}: more would not fit the adapter or the memory allowed",
            estimate.size,
            estimate.unit,
        );
    }
    wanted.min(estimate.size)
}

struct Run<'a> {
    context: Arc<Context>,
    steps: u32,
    frames: Vec<&'a Frame>,
    background: Background,
    order: Vec<usize>,
    rng: Pcg64,
    learner: Box<dyn Learner>,
    raster: Rasterizer,
    loss: ImageLoss,
    wavelet: bool,
    began: Instant,
    recent: Recent,
}

/// Figures since the last report.
struct Recent {
    since: Instant,
    step: u32,
    average: Option<LossSums>,
}

impl<'a> Run<'a> {
    fn begin(
        context: &Arc<Context>,
        dataset: &'a Dataset,
        options: &TrainOptions,
        budget: &MemoryBudget,
    ) -> Result<Self, TrainError> {
        let frames: Vec<&Frame> = dataset.split(Split::Train).collect();
        if frames.is_empty() {
            return Err(TrainError::NoTrainingFrames);
        }
        let mut schedule = Schedule::new(options);
        let estimate = Needs::of(dataset, options, context.adapter()).within(budget)?;
        tracing::info!("memory: {estimate}");
        let steps = schedule.steps;
        let mut rng = Pcg64::seed_from_u64(options.seed);
        let (points, colors) = match &dataset.points {
            Some(cloud) if !cloud.positions.is_empty() => (cloud.positions.clone(), &cloud.colors[..]),
            _ => {
                let (low, high) = start_box(dataset.layout, &frames);
                (random_points(&mut rng, schedule.random_points, low, high), &[][..])
            }
        };
        let extent = camera_extent(&frames);
        let learner: Box<dyn Learner> = match options.model {
            ModelKind::Tcgs | ModelKind::Scaffold => {
                schedule.max_anchors = cap(schedule.max_anchors, &estimate);
                Box::new(AnchorLearner::begin(context, schedule, &points, extent, &mut rng)?)
            }
            ModelKind::Gaussians3d => {
                let mut schedule = PlainSchedule::new(options, steps);
                schedule.max_gaussians = cap(schedule.max_gaussians, &estimate);
                Box::new(PlainLearner::begin(context, schedule, &points, colors, extent, &mut rng)?)
            }
        };
        let now = Instant::now();
        Ok(Self {
            steps,
            background: options.background,
            order: Vec::new(),
            rng,
            learner,
            raster: Rasterizer::new(Arc::clone(context), RasterSettings::default())?,
            loss: ImageLoss::new(Arc::clone(context))?,
            wavelet: options.has(Component::Wavelet),
            began: now,
            recent: Recent { since: now, step: 0, average: None },
            context: Arc::clone(context),
            frames,
        })
    }

    /// The next photograph: every one once before any comes again.
    fn next_frame(&mut self) -> usize {
        if self.order.is_empty() {
            self.order = (0..self.frames.len()).collect();
            self.order.shuffle(&mut self.rng);
        }
        self.order.pop().unwrap_or(0)
    }

    fn step(&mut self, number: u32) -> Result<(), TrainError> {
        let step = Step { number, fraction: f64::from(number) / f64::from(self.steps.max(1)) };
        let index = self.next_frame();
        let camera = self.frames[index].camera;
        let context = Arc::clone(&self.context);
        loop {
            let mut recorder = context.recorder("forward");
            self.learner.forward(&mut recorder, &camera, &step)?;
            self.raster.forward(&mut recorder, self.learner.gaussians(), &camera, self.background.rgb())?;
            recorder.submit()?;
            let counts = self.raster.counts()?;
            if !counts.overflowed {
                break;
            }
            self.raster.grow(&counts)?;
        }
        // Packed when it is needed: a second copy of every image would double what a dataset takes.
        let photograph = self.frames[index].image.load()?;
        let photograph = pack(photograph.over(self.background.rgb8()).samples());
        let mut recorder = context.recorder("backward");
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        let wavelet = self.wavelet.then(|| WaveletWeights::at(step.fraction));
        let v_image =
            self.loss.record(&mut recorder, size, self.raster.image(), &photograph, wavelet.as_ref())?;
        let gaussians = self.learner.gaussians().clone();
        let d_gaussians = self.learner.gaussian_gradients()?;
        self.raster.backward(&mut recorder, &gaussians, &camera, v_image, &d_gaussians)?;
        self.learner.backward(&mut recorder, &camera, &step)?;
        recorder.submit()?;
        self.learner.adapt(&step, &mut self.rng)
    }

    fn progress(&mut self, step: u32) -> Result<Progress, TrainError> {
        let sums = self.loss.sums()?.ok_or(TrainError::Diverged { step })?;
        if !sums.loss().is_finite() {
            return Err(TrainError::Diverged { step });
        }
        let blend = |old: f64, new: f64| 0.9 * old + 0.1 * new;
        let average = self.recent.average.map_or(sums, |old| LossSums {
            ssim: blend(old.ssim, sums.ssim),
            l1: blend(old.l1, sums.l1),
            mse: blend(old.mse, sums.mse),
            wavelet: blend(old.wavelet, sums.wavelet),
        });
        self.recent.average = Some(average);
        let elapsed = self.began.elapsed().as_secs_f64();
        let recent = self.recent.since.elapsed().as_secs_f64();
        let speed = (recent > 0.0).then(|| f64::from(step - self.recent.step) / recent);
        self.recent.since = Instant::now();
        self.recent.step = step;
        let left = f64::from(self.steps - step);
        let size = self.learner.size()?;
        Ok(Progress {
            step: u64::from(step),
            total: u64::from(self.steps),
            elapsed_seconds: elapsed,
            eta_seconds: Some(left * elapsed / f64::from(step)),
            steps_per_second: speed,
            anchors: size.anchors as u64,
            gaussians: size.gaussians as u64,
            loss: Some(average.loss()),
            psnr: Some(average.psnr()),
        })
    }

    fn finish(self, cancel: &CancelFlag) -> Result<Trained, TrainError> {
        Ok(Trained {
            scene: self.learner.finish(&self.frames, cancel)?,
            steps: self.steps,
            seconds: self.began.elapsed().as_secs_f64(),
        })
    }
}
