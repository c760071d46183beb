//! The training loop: each step renders one photograph's view, takes the losses' gradients back and updates the parameters;
//! between steps the model grows and is pruned.
//!
//! A step is one submission, and steps are submitted in batches: after each batch the host reads whether a step overflowed the
//! rasteriser's buffers, and repeats the steps from there with larger ones.

use std::{sync::Arc, time::Instant};

use rand::{SeedableRng, seq::SliceRandom};
use rand_pcg::Pcg64;

use super::{
    Checkpoint, CheckpointSink, Estimate, ImageLoss, LossSums, Needs, RateControl, Schedule, TrainError,
    WaveletWeights,
    anchor_trainer::AnchorTrainer,
    batch::{Batch, REPORT_INTERVAL},
    checkpoint::{ModelState, RunIdentity, RunState},
    init_bounds::init_bounds,
    loss::pack,
    model_trainer::{BitrateSample, FinishedModel, ModelTrainer, Step},
    plain::PlainTrainer,
    trained::Trained,
    typical_distance::typical_distance,
};
use crate::{
    domain::{
        Background, CancelFlag, Component, Dataset, Frame, MemoryBudget, ModelKind, NearPlane, Progress,
        SceneScale, Split, TrainOptions,
    },
    gpu::Device,
    model::random_points,
    render::{RasterSettings, Rasterizer},
};

/// The checkpoint that a run resumes from and where it saves checkpoints; neither changes the result.
#[derive(Default)]
pub struct Checkpoints<'a> {
    /// A checkpoint of this run to resume from.
    pub resume: Option<Checkpoint>,
    /// Saves checkpoints: those that it wants, one when the run is cancelled, and one after the last step.
    pub sink: Option<&'a mut dyn CheckpointSink>,
}

/// Trains a scene on the dataset's training frames.
///
/// `report` is called every few steps, and at once if the run resumes from a checkpoint. The result depends only on dataset,
/// options and adapter.
///
/// # Errors
/// [`TrainError`]; a cancelled run ends as [`TrainError::Cancelled`] within a step or about a second, or within one view of the
/// final pruning pass. [`TrainError::Checkpoint`] only before the first step.
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

/// Like [`train`], with growth limited to what fits `budget`.
///
/// # Errors
/// Those of [`train`], and [`TrainError::OverBudget`] before the first step.
pub fn train_within(
    device: &Arc<Device>,
    dataset: &Dataset,
    options: &TrainOptions,
    budget: &MemoryBudget,
    checkpoints: Checkpoints<'_>,
    report: &mut dyn FnMut(&Progress),
    cancel: &CancelFlag,
) -> Result<Trained, TrainError> {
    let mut run = Run::new(device, dataset, options, budget, checkpoints.resume)?;
    let last = run.steps;
    run.run_until(last, checkpoints.sink, report, cancel)?;
    run.finish(cancel)
}

/// Trains the steps that the branches of a rate-distortion curve share, up to [`Schedule::fork_step`], and returns the
/// checkpoint for [`Checkpoint::fork`], which is saved too.
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
    let mut run = Run::new(device, dataset, options, budget, checkpoints.resume)?;
    run.run_until(run.fork_step, checkpoints.sink, report, cancel)?;
    run.checkpoint()
}

/// Saves checkpoints of a run, at most one per step.
struct CheckpointWriter<'a> {
    sink: Option<&'a mut dyn CheckpointSink>,
    /// Step of the newest checkpoint.
    saved_step: u32,
}

impl CheckpointWriter<'_> {
    fn wants(&mut self, step: u32) -> bool {
        self.sink.as_mut().is_some_and(|sink| sink.wants(step))
    }

    /// The report, with the step of the newest checkpoint.
    fn with_checkpoint_step(&self, progress: Progress) -> Progress {
        Progress { checkpoint_step: u64::from(self.saved_step), ..progress }
    }

    /// Saves the run's state. A failure is only logged: the run can continue without a checkpoint.
    fn save(&mut self, run: &Run<'_>) {
        let step = run.state.step;
        let Some(sink) = self.sink.as_mut().filter(|_| step != self.saved_step) else { return };
        match run.checkpoint().and_then(|checkpoint| Ok(sink.save(&checkpoint)?)) {
            Ok(()) => self.saved_step = step,
            Err(error) => tracing::warn!(step, "checkpoint of step {step} not saved: {error}"),
        }
    }
}

/// The scene's extent: 1.1 times the largest distance of a training camera from the cameras' mean position.
fn camera_extent(frames: &[&Frame]) -> f32 {
    let centers: Vec<_> = frames.iter().map(|frame| frame.camera.pose.center()).collect();
    let mean = centers.iter().sum::<glam::DVec3>() / centers.len().max(1) as f64;
    let radius = centers.iter().map(|center| center.distance(mean)).fold(0.0, f64::max);
    // A single camera has no radius: any extent will do.
    if radius > 0.0 { (1.1 * radius) as f32 } else { 1.0 }
}

/// Warns if growth is capped by memory.
fn warn_if_capped(wanted: usize, estimate: &Estimate) {
    if estimate.size < wanted {
        tracing::warn!(
            "growth capped at {} {} instead of {wanted} by the adapter or the memory budget",
            estimate.size,
            estimate.unit,
        );
    }
}

/// Creates the model's trainer, new or from a checkpoint.
struct ModelFactory<'a> {
    device: &'a Arc<Device>,
    dataset: &'a Dataset,
    frames: &'a [&'a Frame],
    schedule: Schedule,
}

impl ModelFactory<'_> {
    /// The trainer at the start of a run.
    fn create(self, rng: &mut Pcg64) -> Result<Box<dyn ModelTrainer>, TrainError> {
        let Self { device, dataset, frames, schedule } = self;
        let (points, colors) = match &dataset.points {
            Some(cloud) if !cloud.positions.is_empty() => (cloud.positions.clone(), &cloud.colors[..]),
            _ => {
                let (low, high) = init_bounds(dataset.layout, frames);
                (random_points(rng, schedule.random_points, low, high), &[][..])
            }
        };
        let extent = camera_extent(frames);
        Ok(match schedule.model {
            ModelKind::Tcgs | ModelKind::Scaffold => {
                let typical = typical_distance(frames, &points);
                let scene_scale = SceneScale::from_typical_distance(typical);
                tracing::debug!(typical, scene_scale = scene_scale.length(), "scene scale");
                Box::new(AnchorTrainer::new(device, schedule, &points, extent, scene_scale, rng)?)
            }
            ModelKind::Gaussians3d => {
                Box::new(PlainTrainer::new(device, schedule.plain, &points, colors, extent, rng)?)
            }
        })
    }

    /// The trainer that a checkpoint holds the state of.
    fn resume(self, state: ModelState) -> Result<Box<dyn ModelTrainer>, TrainError> {
        let Self { device, frames, schedule, .. } = self;
        let extent = camera_extent(frames);
        Ok(match schedule.model {
            ModelKind::Tcgs | ModelKind::Scaffold => {
                Box::new(AnchorTrainer::resume(device, schedule, extent, state)?)
            }
            ModelKind::Gaussians3d => Box::new(PlainTrainer::resume(device, schedule.plain, extent, state)?),
        })
    }
}

struct Run<'a> {
    device: Arc<Device>,
    steps: u32,
    /// See [`Schedule::fork_step`].
    fork_step: u32,
    frames: Vec<&'a Frame>,
    background: Background,
    /// Its seconds are those before `started`.
    state: RunState,
    /// Adjusts lambda towards the target size, if there is one.
    control: Option<RateControl>,
    model: Box<dyn ModelTrainer>,
    raster: Rasterizer,
    loss: ImageLoss,
    wavelet: bool,
    started: Instant,
    first_step: u32,
    reported: (Instant, u32),
    batch: Batch,
    /// The next photograph, by its index among the frames.
    prepared: Option<(usize, Vec<u32>)>,
}

impl<'a> Run<'a> {
    fn new(
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
        let mut schedule = Schedule::new(options);
        let estimate = Needs::of(dataset, options, device.adapter()).within(budget)?;
        tracing::info!("memory: {estimate}");
        warn_if_capped(schedule.max_size(), &estimate);
        let (steps, fork_step) = (schedule.steps, schedule.fork_step());
        let control = schedule.rate_control(options.max_bytes);
        let adapter = device.adapter_line();
        let max_size = estimate.size;
        let identity = RunIdentity { options, dataset: dataset.digest, adapter: &adapter, max_size };
        let (state, model) = match resume {
            Some(checkpoint) => {
                let (mut state, saved) = checkpoint.open(identity, steps, frames.len())?;
                tracing::info!(step = state.step, "resuming from step {}", state.step);
                state.continue_on(&adapter, max_size);
                schedule.set_max_size(state.max_size);
                (state, ModelFactory { device, dataset, frames: &frames, schedule }.resume(saved)?)
            }
            None => {
                let mut rng = Pcg64::seed_from_u64(options.seed);
                let lambda = schedule.lambda();
                schedule.set_max_size(max_size);
                let model = ModelFactory { device, dataset, frames: &frames, schedule }.create(&mut rng)?;
                (RunState::new(identity, rng, lambda), model)
            }
        };
        let control = control.map(|control| state.resume_control(control));
        let near = NearPlane::of_extent(camera_extent(&frames)).depth();
        let settings = RasterSettings { near, ..RasterSettings::default() };
        let now = Instant::now();
        Ok(Self {
            steps,
            fork_step,
            control,
            background: options.background,
            model,
            raster: Rasterizer::new(Arc::clone(device), settings)?,
            loss: ImageLoss::new(Arc::clone(device))?,
            wavelet: options.has(Component::Wavelet),
            started: now,
            first_step: state.step,
            reported: (now, state.step),
            // The first batch is one step: it compiles kernels and allocates buffers.
            batch: Batch::Timed { seconds_per_step: 1.0 },
            prepared: None,
            state,
            device: Arc::clone(device),
            frames,
        })
    }

    /// Runs the steps up to `last`.
    fn run_until(
        &mut self,
        last: u32,
        sink: Option<&mut dyn CheckpointSink>,
        report: &mut dyn FnMut(&Progress),
        cancel: &CancelFlag,
    ) -> Result<(), TrainError> {
        let mut writer = CheckpointWriter { sink, saved_step: self.state.step };
        if self.state.step > 0 {
            report(&writer.with_checkpoint_step(self.progress(None)?));
        }
        while self.state.step < last {
            if cancel.is_cancelled() {
                writer.save(self);
                return Err(TrainError::Cancelled);
            }
            self.advance(&mut |step| step == last || writer.wants(step), cancel)?;
            let step = self.state.step;
            let mut progress = None;
            if step.is_multiple_of(REPORT_INTERVAL) || step == self.steps {
                let sums = self.sums()?;
                self.update_bitrate()?;
                progress = Some(self.progress(Some(sums))?);
            }
            // Before the report, which states its step.
            if writer.wants(step) || step == last {
                writer.save(self);
            }
            if let Some(progress) = progress {
                report(&writer.with_checkpoint_step(progress));
            }
        }
        Ok(())
    }

    /// The next photograph: all of them in random order, then again in another order.
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

    /// Runs a batch of steps: up to the next one that the host has to act after, or that `wanted` names.
    ///
    /// Nothing is read back in between. If a pass overflowed its buffer of intersections, it and the passes after it changed
    /// nothing, and are repeated with a larger buffer. Returns the number of recorded steps, repeated ones included.
    fn advance(
        &mut self,
        wanted: &mut dyn FnMut(u32) -> bool,
        cancel: &CancelFlag,
    ) -> Result<u32, TrainError> {
        let started = Instant::now();
        let max_steps = self.batch.length();
        let mut before = Vec::new();
        let mut recorded = 0;
        let last = loop {
            before.push(self.state.clone());
            self.record()?;
            recorded += 1;
            let step = self.at(self.state.step);
            let is_last = step.number == self.steps
                || step.number.is_multiple_of(REPORT_INTERVAL)
                || before.len() >= max_steps
                || self.model.adapts(&step)
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
        self.batch.update(recorded, started.elapsed().as_secs_f64());
        if self.model.adapts(&last) {
            self.model.adapt(&last, &mut self.state.rng, &self.frames, cancel)?;
        }
        Ok(recorded)
    }

    /// A photograph packed for the device. Packed when needed: keeping packed copies would double the dataset's memory.
    fn packed(&self, index: usize) -> Result<Vec<u32>, TrainError> {
        let photograph = self.frames[index].image.load()?;
        Ok(pack(photograph.over(self.background.rgb8()).samples()))
    }

    /// Packs the next photograph, if it is already known, while the device is busy.
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
        self.model.forward(&mut recorder, &camera, &step)?;
        self.raster.forward(&mut recorder, self.model.gaussians(), &camera, self.background.rgb())?;
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        let wavelet = self.wavelet.then(|| WaveletWeights::at(step.fraction));
        let v_image =
            self.loss.record(&mut recorder, size, self.raster.image(), &photograph, wavelet.as_ref())?;
        let gaussians = self.model.gaussians().clone();
        let d_gaussians = self.model.gaussian_gradients()?;
        self.raster.backward(&mut recorder, &gaussians, &camera, v_image, &d_gaussians)?;
        self.model.backward(&mut recorder, &camera, &step, self.raster.overflow_flag())?;
        recorder.submit()?;
        self.state.step = step.number;
        Ok(())
    }

    /// The losses of the last step.
    fn sums(&self) -> Result<LossSums, TrainError> {
        let diverged = TrainError::Diverged { step: self.state.step };
        self.loss.sums()?.filter(|sums| sums.loss().is_finite()).ok_or(diverged)
    }

    /// Updates the estimate of the file's size, and lambda, from the last step's sample.
    fn update_bitrate(&mut self) -> Result<(), TrainError> {
        let Some(BitrateSample { bits_per_anchor, other_bytes }) = self.model.bitrate()? else {
            return Ok(());
        };
        let anchors = self.model.anchors() as f64;
        self.state.observe_bits(bits_per_anchor, anchors, other_bytes);
        if let (Some(control), Some(bytes)) = (&mut self.control, self.state.file_bytes()) {
            control.observe(self.state.step, bytes as f64, other_bytes);
            self.state.set_rate_control(control);
        }
        Ok(())
    }

    /// The progress report, with new losses if given.
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
        let steps_per_second = |since: Instant, from: u32| {
            let seconds = since.elapsed().as_secs_f64();
            (step > from && seconds > 0.0).then(|| f64::from(step - from) / seconds)
        };
        let speed = steps_per_second(self.reported.0, self.reported.1);
        let mean_speed = steps_per_second(self.started, self.first_step);
        self.reported = (Instant::now(), step);
        let size = self.model.size()?;
        Ok(Progress {
            step: u64::from(step),
            total: u64::from(self.steps),
            elapsed_seconds: self.started.elapsed().as_secs_f64(),
            eta_seconds: mean_speed.map(|speed| f64::from(self.steps - step) / speed),
            steps_per_second: speed,
            anchors: size.anchors as u64,
            gaussians: size.gaussians as u64,
            loss: average.map(|average| average.loss()),
            psnr: average.map(|average| average.psnr()),
            ssim: average.map(|average| average.ssim),
            bytes: self.state.file_bytes(),
            checkpoint_step: 0,
        })
    }

    fn checkpoint(&self) -> Result<Checkpoint, TrainError> {
        let mut state = self.state.clone();
        state.seconds += self.started.elapsed().as_secs_f64();
        Ok(Checkpoint::new(state, self.model.save()?))
    }

    fn finish(self, cancel: &CancelFlag) -> Result<Trained, TrainError> {
        let FinishedModel { scene, unrounded, context } = self.model.finish(&self.frames, cancel)?;
        let seconds = self.state.seconds + self.started.elapsed().as_secs_f64();
        Ok(Trained { scene, unrounded, context, steps: self.steps, seconds })
    }
}

#[cfg(test)]
mod tests;
