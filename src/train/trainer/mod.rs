//! The step loop: one photograph a step, forward, losses, backward, optimiser, and now and then growth and pruning.
//!
//! A step is one submission, and steps are sent in batches: the host looks after each batch whether every step had room, and
//! does those again that had not.

use std::{sync::Arc, time::Instant};

use rand::{SeedableRng, seq::SliceRandom};
use rand_pcg::Pcg64;

use super::{
    BaseSteps, Checkpoint, Estimate, ImageLoss, KeepCheckpoints, LossSums, Needs, RateControl, Schedule,
    TrainError, WaveletWeights,
    anchor_trainer::AnchorLearner,
    batch::Batch,
    checkpoint::{LearnerState, Origin, RunState},
    init_bounds::start_box,
    loss::pack,
    model_trainer::{Finished, Learner, SampleRate, Step},
    plain::PlainLearner,
    schedule::PlainSchedule,
    typical_distance::typical_distance,
};
use crate::{
    domain::{
        Background, CancelFlag, Component, ContextCandidates, Dataset, DistanceUnit, Frame, MemoryBudget,
        ModelKind, NearPlane, Progress, Scene, Split, TrainOptions,
    },
    gpu::Device,
    model::random_points,
    render::{RasterSettings, Rasterizer},
};

/// Steps between two reports of progress, and so the most that are on their way to the device.
pub(super) const REPORT_EVERY: u32 = 10;

/// A finished training run.
#[derive(Debug, Clone)]
pub struct Trained {
    /// The scene, not yet quantised.
    pub scene: Scene,
    /// What compression-aware training found for the encoder; none for the baselines.
    pub context: Option<TrainedContext>,
    /// Steps done.
    pub steps: u32,
    /// Seconds of training.
    pub seconds: f64,
}

/// What compression-aware training leaves for the encoder.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainedContext {
    /// The base steps that the scene was trained with.
    pub steps: BaseSteps,
    /// The contexts to choose from.
    pub candidates: ContextCandidates,
}

/// What a run goes on from, and who keeps what others may go on from; neither changes what comes of it.
#[derive(Default)]
pub struct Checkpoints<'a> {
    /// A checkpoint of this run to go on from, instead of its begin.
    pub resume: Option<Checkpoint>,
    /// Keeps checkpoints: those that it wants, one when the run is cancelled, and one after the last step.
    pub keep: Option<&'a mut dyn KeepCheckpoints>,
}

/// Trains a scene on the dataset's training frames.
///
/// `report` is called every few steps, and at once where the run goes on from a checkpoint. The run is a function of dataset,
/// options and adapter.
///
/// # Errors
/// [`TrainError`]; a cancelled run ends as [`TrainError::Cancelled`] within a step or about a second, or within a view
/// of the pass that ends it. [`TrainError::Checkpoint`] only before the first step.
pub fn train(
    device: &Arc<Device>,
    dataset: &Dataset,
    options: &TrainOptions,
    checkpoints: Checkpoints<'_>,
    report: &mut dyn FnMut(&Progress),
    cancel: &CancelFlag,
) -> Result<Trained, TrainError> {
    let budget = MemoryBudget { host: u64::MAX, gpu: device.budget_bytes() };
    train_within(device, dataset, options, &budget, checkpoints, report, cancel)
}

/// As [`train`], growing no further than `budget` allows.
///
/// # Errors
/// As [`train`], and [`TrainError::OverBudget`] before anything is done.
pub fn train_within(
    device: &Arc<Device>,
    dataset: &Dataset,
    options: &TrainOptions,
    budget: &MemoryBudget,
    checkpoints: Checkpoints<'_>,
    report: &mut dyn FnMut(&Progress),
    cancel: &CancelFlag,
) -> Result<Trained, TrainError> {
    let Checkpoints { resume, keep } = checkpoints;
    let mut run = Run::begin(device, dataset, options, budget, resume)?;
    let last = run.steps;
    run.go_on(last, keep, report, cancel)?;
    run.finish(cancel)
}

/// Trains what the branches of a rate-distortion curve share: up to [`Schedule::fork_step`]. The checkpoint, which is kept
/// too, is for [`Checkpoint::fork`].
///
/// # Errors
/// As [`train_within`].
pub fn train_trunk(
    device: &Arc<Device>,
    dataset: &Dataset,
    options: &TrainOptions,
    budget: &MemoryBudget,
    checkpoints: Checkpoints<'_>,
    report: &mut dyn FnMut(&Progress),
    cancel: &CancelFlag,
) -> Result<Checkpoint, TrainError> {
    let Checkpoints { resume, keep } = checkpoints;
    let mut run = Run::begin(device, dataset, options, budget, resume)?;
    run.go_on(Schedule::new(options).fork_step(), keep, report, cancel)?;
    run.checkpoint()
}

/// Keeps checkpoints of a run, none of them twice.
struct Keeper<'a> {
    keep: Option<&'a mut dyn KeepCheckpoints>,
    /// Step of the newest checkpoint.
    kept: u32,
}

impl Keeper<'_> {
    fn wants(&mut self, step: u32) -> bool {
        self.keep.as_mut().is_some_and(|keep| keep.wants(step))
    }

    /// The report, with the step of the newest checkpoint.
    fn marked(&self, progress: Progress) -> Progress {
        Progress { checkpoint_step: u64::from(self.kept), ..progress }
    }

    /// A run without a checkpoint is better than none, so a failure is told and no more.
    fn keep(&mut self, run: &Run<'_>) {
        let step = run.state.step;
        let Some(keep) = self.keep.as_mut().filter(|_| step != self.kept) else { return };
        let kept = run.checkpoint().and_then(|checkpoint| Ok(keep.keep(&checkpoint)?));
        match kept {
            Ok(()) => self.kept = step,
            Err(fault) => tracing::warn!(step, "no checkpoint is kept at step {step}: {fault}"),
        }
    }
}

/// 1.1 times the largest distance of a training camera from their mean: the scene's extent.
fn camera_extent(frames: &[&Frame]) -> f32 {
    let centers: Vec<_> = frames.iter().map(|frame| frame.camera.pose.center()).collect();
    let mean = centers.iter().sum::<glam::DVec3>() / centers.len().max(1) as f64;
    let radius = centers.iter().map(|center| center.distance(mean)).fold(0.0, f64::max);
    // A single camera has no radius; its distance unit is as good as any.
    if radius > 0.0 { (1.1 * radius) as f32 } else { 1.0 }
}

/// Tells where memory, not the schedule, bounds growth.
fn tell_cap(wanted: usize, estimate: &Estimate) {
    if estimate.size < wanted {
        tracing::warn!(
            "growth stops at {} {} instead of {wanted}: more would not fit the adapter or the memory allowed",
            estimate.size,
            estimate.unit,
        );
    }
}

/// What a learner is made for.
struct Setting<'a> {
    device: &'a Arc<Device>,
    dataset: &'a Dataset,
    options: &'a TrainOptions,
    frames: &'a [&'a Frame],
    /// Size that growth may reach.
    most: usize,
}

impl Setting<'_> {
    fn anchors(&self) -> Schedule {
        Schedule { max_anchors: self.most, ..Schedule::new(self.options) }
    }

    fn plain(&self) -> PlainSchedule {
        let steps = Schedule::new(self.options).steps;
        PlainSchedule { max_gaussians: self.most, ..PlainSchedule::new(self.options, steps) }
    }

    /// A learner at the begin of its run.
    fn fresh(&self, rng: &mut Pcg64) -> Result<Box<dyn Learner>, TrainError> {
        let (points, colors) = match &self.dataset.points {
            Some(cloud) if !cloud.positions.is_empty() => (cloud.positions.clone(), &cloud.colors[..]),
            _ => {
                let (low, high) = start_box(self.dataset.layout, self.frames);
                (random_points(rng, self.anchors().random_points, low, high), &[][..])
            }
        };
        let (device, extent) = (self.device, camera_extent(self.frames));
        Ok(match self.options.model {
            ModelKind::Tcgs | ModelKind::Scaffold => {
                let typical = typical_distance(self.frames, &points);
                let unit = DistanceUnit::of_typical(typical);
                tracing::debug!(typical, unit = unit.length(), "what distances are told in");
                Box::new(AnchorLearner::begin(device, self.anchors(), &points, extent, unit, rng)?)
            }
            ModelKind::Gaussians3d => {
                Box::new(PlainLearner::begin(device, self.plain(), &points, colors, extent, rng)?)
            }
        })
    }

    /// The learner that a checkpoint was taken of.
    fn resumed(&self, state: LearnerState) -> Result<Box<dyn Learner>, TrainError> {
        let (device, extent) = (self.device, camera_extent(self.frames));
        Ok(match self.options.model {
            ModelKind::Tcgs | ModelKind::Scaffold => {
                Box::new(AnchorLearner::resume(device, self.anchors(), extent, state)?)
            }
            ModelKind::Gaussians3d => Box::new(PlainLearner::resume(device, self.plain(), extent, state)?),
        })
    }
}

struct Run<'a> {
    device: Arc<Device>,
    steps: u32,
    frames: Vec<&'a Frame>,
    background: Background,
    /// Its seconds are those before `began`.
    state: RunState,
    /// Steers the weight of the rate, where a size was promised.
    control: Option<RateControl>,
    learner: Box<dyn Learner>,
    raster: Rasterizer,
    loss: ImageLoss,
    wavelet: bool,
    began: Instant,
    began_at: u32,
    reported: (Instant, u32),
    batch: Batch,
    /// The next photograph, by its index among the frames.
    prepared: Option<(usize, Vec<u32>)>,
}

impl<'a> Run<'a> {
    fn begin(
        device: &Arc<Device>,
        dataset: &'a Dataset,
        options: &TrainOptions,
        budget: &MemoryBudget,
        resume: Option<Checkpoint>,
    ) -> Result<Self, TrainError> {
        let frames: Vec<&Frame> = dataset.split(Split::Train).collect();
        if frames.is_empty() {
            return Err(TrainError::NoTrainingFrames);
        }
        let schedule = Schedule::new(options);
        let estimate = Needs::of(dataset, options, device.adapter()).within(budget)?;
        tracing::info!("memory: {estimate}");
        let wanted = match options.model {
            ModelKind::Tcgs | ModelKind::Scaffold => schedule.max_anchors,
            ModelKind::Gaussians3d => PlainSchedule::new(options, schedule.steps).max_gaussians,
        };
        tell_cap(wanted, &estimate);
        let steps = schedule.steps;
        let adapter = device.adapter_line();
        let most = estimate.size;
        let origin = Origin { options, dataset: dataset.digest, adapter: &adapter, most };
        let setting = Setting { device, dataset, options, frames: &frames, most };
        let (state, learner) = match resume {
            Some(checkpoint) => {
                let (mut state, saved) = checkpoint.open(origin, steps, frames.len())?;
                tracing::info!(step = state.step, "going on from step {}", state.step);
                state.move_to(&adapter, most);
                let learner = Setting { most: state.most, ..setting }.resumed(saved)?;
                (state, learner)
            }
            None => {
                let mut rng = Pcg64::seed_from_u64(options.seed);
                let learner = setting.fresh(&mut rng)?;
                (RunState::begin(origin, rng, schedule.lambda()), learner)
            }
        };
        let control = schedule.rate_control(options.max_bytes).map(|control| state.resume_control(control));
        let near = NearPlane::of_extent(camera_extent(&frames)).depth();
        let settings = RasterSettings { near, ..RasterSettings::default() };
        let now = Instant::now();
        Ok(Self {
            steps,
            control,
            background: options.background,
            learner,
            raster: Rasterizer::new(Arc::clone(device), settings)?,
            loss: ImageLoss::new(Arc::clone(device))?,
            wavelet: options.has(Component::Wavelet),
            began: now,
            began_at: state.step,
            reported: (now, state.step),
            // The first step, which compiles kernels and makes buffers, is waited for.
            batch: Batch::Timed { seconds_a_step: 1.0 },
            prepared: None,
            state,
            device: Arc::clone(device),
            frames,
        })
    }

    /// Does the steps up to `last`.
    fn go_on(
        &mut self,
        last: u32,
        keep: Option<&mut dyn KeepCheckpoints>,
        report: &mut dyn FnMut(&Progress),
        cancel: &CancelFlag,
    ) -> Result<(), TrainError> {
        let mut keeper = Keeper { keep, kept: self.state.step };
        if self.state.step > 0 {
            report(&keeper.marked(self.progress(None)?));
        }
        while self.state.step < last {
            if cancel.is_cancelled() {
                keeper.keep(self);
                return Err(TrainError::Cancelled);
            }
            self.advance(&mut |step| step == last || keeper.wants(step), cancel)?;
            let step = self.state.step;
            let mut progress = None;
            if step.is_multiple_of(REPORT_EVERY) || step == self.steps {
                let sums = self.sums()?;
                self.weigh()?;
                progress = Some(self.progress(Some(sums))?);
            }
            // Before the report, which tells of it.
            if keeper.wants(step) || step == last {
                keeper.keep(self);
            }
            if let Some(progress) = progress {
                report(&keeper.marked(progress));
            }
        }
        Ok(())
    }

    /// The next photograph: every one once before any comes again.
    fn next_frame(&mut self) -> usize {
        let RunState { order, rng, .. } = &mut self.state;
        if order.is_empty() {
            order.extend(0..self.frames.len());
            order.shuffle(rng);
        }
        order.pop().unwrap_or(0)
    }

    fn at(&self, number: u32) -> Step {
        let fraction = f64::from(number) / f64::from(self.steps.max(1));
        Step { number, fraction, lambda: self.state.lambda() }
    }

    /// Does the steps up to the next after which the host has something to do, or `wanted` says that it has.
    ///
    /// Nothing is read back in between. If a pass found no room for its intersections, it and those after it changed
    /// nothing; they are done again with more. Returns how many were recorded, with those that were void.
    fn advance(
        &mut self,
        wanted: &mut dyn FnMut(u32) -> bool,
        cancel: &CancelFlag,
    ) -> Result<u32, TrainError> {
        let began = Instant::now();
        let most = self.batch.length();
        let mut before = Vec::new();
        let mut recorded = 0;
        let last = loop {
            before.push(self.state.clone());
            self.record()?;
            recorded += 1;
            let step = self.at(self.state.step);
            let is_last = step.number == self.steps
                || step.number.is_multiple_of(REPORT_EVERY)
                || before.len() >= most
                || self.learner.adapts(&step)
                || wanted(step.number);
            if !is_last {
                continue;
            }
            self.prepare_next()?;
            let passes = self.raster.take_forward_passes()?;
            let Some(needed) = passes.required else { break step };
            let first = (passes.completed as usize).min(before.len() - 1);
            tracing::debug!(step = before[first].step + 1, needed, "no room for all intersections");
            self.state = before.swap_remove(first);
            before.clear();
            self.raster.reserve(needed)?;
        };
        self.batch.learn(recorded, began.elapsed().as_secs_f64());
        if self.learner.adapts(&last) {
            self.learner.adapt(&last, &mut self.state.rng, &self.frames, cancel)?;
        }
        Ok(recorded)
    }

    /// A photograph as the device takes it, made when it is needed: a second copy of every image would double what a dataset takes.
    fn packed(&self, index: usize) -> Result<Vec<u32>, TrainError> {
        let photograph = self.frames[index].image.load()?;
        Ok(pack(photograph.over(self.background.rgb8()).samples()))
    }

    /// Packs the next photograph, if it is known, while the device is busy.
    fn prepare_next(&mut self) -> Result<(), TrainError> {
        let next = self.state.order.last().copied();
        self.prepared = next.map(|index| Ok::<_, TrainError>((index, self.packed(index)?))).transpose()?;
        Ok(())
    }

    /// Records and submits one step.
    fn record(&mut self) -> Result<(), TrainError> {
        let step = self.at(self.state.step + 1);
        let index = self.next_frame();
        let camera = self.frames[index].camera;
        let photograph = match self.prepared.take() {
            Some((prepared, photograph)) if prepared == index => photograph,
            _ => self.packed(index)?,
        };
        let device = Arc::clone(&self.device);
        let mut recorder = device.recorder("step");
        self.learner.forward(&mut recorder, &camera, &step)?;
        self.raster.forward(&mut recorder, self.learner.gaussians(), &camera, self.background.rgb())?;
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        let wavelet = self.wavelet.then(|| WaveletWeights::at(step.fraction));
        let v_image =
            self.loss.record(&mut recorder, size, self.raster.image(), &photograph, wavelet.as_ref())?;
        let gaussians = self.learner.gaussians().clone();
        let d_gaussians = self.learner.gaussian_gradients()?;
        self.raster.backward(&mut recorder, &gaussians, &camera, v_image, &d_gaussians)?;
        self.learner.backward(&mut recorder, &camera, &step, self.raster.overflow_flag())?;
        recorder.submit()?;
        self.state.step = step.number;
        Ok(())
    }

    /// The losses of the last step.
    fn sums(&self) -> Result<LossSums, TrainError> {
        let diverged = TrainError::Diverged { step: self.state.step };
        self.loss.sums()?.filter(|sums| sums.loss().is_finite()).ok_or(diverged)
    }

    /// Takes the last step's sample into the estimate of the file's bytes.
    fn weigh(&mut self) -> Result<(), TrainError> {
        let Some(SampleRate { bits_an_anchor, other_bytes }) = self.learner.rate()? else { return Ok(()) };
        let anchors = self.learner.anchors() as f64;
        self.state.weigh(bits_an_anchor, anchors, other_bytes);
        if let (Some(control), Some(bytes)) = (&mut self.control, self.state.file_bytes()) {
            control.observe(self.state.step, bytes as f64, other_bytes);
            self.state.steer(control);
        }
        Ok(())
    }

    /// How far the run is, with losses where there are new ones.
    fn progress(&mut self, sums: Option<LossSums>) -> Result<Progress, TrainError> {
        let blend = |old: f64, new: f64| 0.9 * old + 0.1 * new;
        if let Some(sums) = sums {
            self.state.set_average(self.state.average().map_or(sums, |old| LossSums {
                ssim: blend(old.ssim, sums.ssim),
                l1: blend(old.l1, sums.l1),
                mse: blend(old.mse, sums.mse),
                wavelet: blend(old.wavelet, sums.wavelet),
            }));
        }
        let average = self.state.average();
        let step = self.state.step;
        let rate = |since: Instant, from: u32| {
            let seconds = since.elapsed().as_secs_f64();
            (step > from && seconds > 0.0).then(|| f64::from(step - from) / seconds)
        };
        let speed = rate(self.reported.0, self.reported.1);
        let mean_speed = rate(self.began, self.began_at);
        self.reported = (Instant::now(), step);
        let size = self.learner.size()?;
        Ok(Progress {
            step: u64::from(step),
            total: u64::from(self.steps),
            elapsed_seconds: self.began.elapsed().as_secs_f64(),
            eta_seconds: mean_speed.map(|speed| f64::from(self.steps - step) / speed),
            steps_per_second: speed,
            anchors: size.anchors as u64,
            gaussians: size.gaussians as u64,
            loss: average.map(|average| average.loss()),
            psnr: average.map(|average| average.psnr()),
            bytes: self.state.file_bytes(),
            checkpoint_step: 0,
        })
    }

    fn checkpoint(&self) -> Result<Checkpoint, TrainError> {
        let mut state = self.state.clone();
        state.seconds += self.began.elapsed().as_secs_f64();
        Ok(Checkpoint::new(state, self.learner.save()?))
    }

    fn finish(self, cancel: &CancelFlag) -> Result<Trained, TrainError> {
        let Finished { scene, context } = self.learner.finish(&self.frames, cancel)?;
        let seconds = self.state.seconds + self.began.elapsed().as_secs_f64();
        Ok(Trained { scene, context, steps: self.steps, seconds })
    }
}

#[cfg(test)]
mod tests;
