//! The training loop: each step renders one photograph's view, takes the losses' gradients back and updates the parameters;
//! between steps the model grows and is pruned.
//!
//! A step is one submission, and steps are submitted in batches, of which two are in flight: while the device works on one, the host
//! records the next and then reads whether a step of the first overflowed the rasterizer's buffers. If so, the steps from there on,
//! which have changed nothing, are repeated with larger ones.

mod checkpoint_writer;
mod model_factory;
mod submission;

use std::{collections::VecDeque, sync::Arc, time::Instant};

use rand::{SeedableRng, seq::SliceRandom};
use rand_pcg::Pcg64;

use checkpoint_writer::CheckpointWriter;
use model_factory::ModelFactory;
use submission::is_long;

use super::{
    Checkpoint, CheckpointSink, ColorCorrections, Estimate, ImageLoss, Learning, LossSums, Needs,
    RateControl, Result, Schedule, TrainError, WaveletWeights,
    batch::{Batch, Flight, REPORT_INTERVAL},
    checkpoint::{RunIdentity, RunState},
    exposure::{ShortRun, Trial, choose},
    loss::PartialSums,
    model_trainer::{BitrateSample, FigureBuffers, FinishedModel, ModelTrainer, Step, Views},
    monitor::Monitor,
    photographs::Photographs,
    scene_extent::scene_extent,
    scene_frame::{TrainingSet, scene_frame},
    trained::Trained,
};
use crate::{
    domain::{
        Background, CancelFlag, Choices, Component, Dataset, Exposure, ExposureChoice, FailurePoint, Frame,
        MemoryBudget, NearPlane, Progress, Scene, SceneFrame, SizeBound, Split, TrainOptions, Widths,
        failure_point::reach,
    },
    eval::ColorFit,
    gpu::{Binding, Device, RawBuffer, Readback, Recorder},
    model::ModelShape,
    render::{RasterSettings, Rasterizer},
};

/// Label of a training step's recording.
pub const STEP_RECORDING: &str = "step";

/// The checkpoint that a run resumes from and where it saves checkpoints; neither changes the result.
#[derive(Default)]
pub struct Checkpoints<'a> {
    /// A checkpoint of this run to resume from.
    pub resume: Option<Checkpoint>,
    /// Saves checkpoints: those that it wants, one when the run is cancelled, and one after the last step.
    pub sink: Option<&'a mut dyn CheckpointSink>,
}

/// A training run on the training frames of a dataset, before its first step. The result depends only on dataset, options and adapter.
pub struct Trainer<'a, 'c> {
    device: &'a Arc<Device>,
    dataset: &'a Dataset,
    options: &'a TrainOptions,
    budget: MemoryBudget,
    checkpoints: Checkpoints<'c>,
    cancel: CancelFlag,
    is_watched: bool,
}

impl<'a, 'c> Trainer<'a, 'c> {
    /// A run from the start that keeps no checkpoints. Its growth is limited by the device's budget ([`Device::budget_bytes`]).
    #[must_use]
    pub fn new(device: &'a Arc<Device>, dataset: &'a Dataset, options: &'a TrainOptions) -> Self {
        let budget = MemoryBudget { host: u64::MAX, gpu: device.budget_bytes() };
        let (checkpoints, cancel) = (Checkpoints::default(), CancelFlag::default());
        Self { device, dataset, options, budget, checkpoints, cancel, is_watched: false }
    }

    /// With previews in the reports, and PSNR of the model as it is. Both take about 3 % of the run's time and change nothing.
    #[must_use]
    pub fn watched(self, is_watched: bool) -> Self {
        Self { is_watched, ..self }
    }

    /// With growth limited to what fits `budget`.
    #[must_use]
    pub fn within(self, budget: MemoryBudget) -> Self {
        Self { budget, ..self }
    }

    /// Resumed from a checkpoint, or saving some.
    #[must_use]
    pub fn with_checkpoints(self, checkpoints: Checkpoints<'c>) -> Self {
        Self { checkpoints, ..self }
    }

    /// Ends as [`TrainError::Cancelled`] once `cancel` is set: within a step or about a second, or within one view of the final
    /// pruning pass.
    #[must_use]
    pub fn cancelled_by(self, cancel: &CancelFlag) -> Self {
        Self { cancel: cancel.clone(), ..self }
    }

    /// Trains to the last step. `observer` is called every few steps, and at once if the run resumes from a checkpoint.
    ///
    /// # Errors
    /// [`TrainError`]; [`TrainError::Checkpoint`] and [`TrainError::TooLarge`] only before the first step.
    pub fn run(self, mut observer: impl FnMut(&Progress)) -> Result<Trained> {
        let cancel = self.cancel.clone();
        self.run_until(Goal::End, &mut observer)?.finish(&cancel)
    }

    /// Trains the steps that the branches of a rate-distortion curve share, up to [`Schedule::fork_step`], and returns the
    /// checkpoint for [`Checkpoint::fork`], which is saved too.
    ///
    /// # Errors
    /// As [`Trainer::run`].
    pub fn run_trunk(self, mut observer: impl FnMut(&Progress)) -> Result<Checkpoint> {
        self.run_until(Goal::Fork, &mut observer)?.checkpoint()
    }

    fn run_until(self, goal: Goal, observer: &mut dyn FnMut(&Progress)) -> Result<Run> {
        let Self { device, dataset, options, budget, checkpoints, cancel, is_watched } = self;
        let started = Instant::now();
        let exposure = match &checkpoints.resume {
            Some(checkpoint) => checkpoint.exposure(),
            None => {
                let train: &ShortRun<'_> = &|dataset, options, report| {
                    Trainer::new(device, dataset, options).within(budget).cancelled_by(&cancel).run(report)
                };
                choose(&Trial { device, dataset, options, cancel: &cancel, train }, observer)?
            }
        };
        let trial_seconds = started.elapsed().as_secs_f64();
        let mut run = Run::with_exposure(device, dataset, options, &budget, checkpoints.resume, exposure)?;
        run.state.seconds += trial_seconds;
        run.monitor = is_watched.then(|| Monitor::new(device, dataset, run.frame, options.background));
        run.run_until(goal, checkpoints.sink, observer, &cancel)?;
        Ok(run)
    }
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

fn has_masks(frames: &[Frame]) -> bool {
    frames.iter().any(|frame| frame.mask.is_some())
}

/// The loss against photographs, of which all pixels count or not.
fn loss_of(device: &Arc<Device>, frames: &[Frame]) -> Result<ImageLoss> {
    let make = if has_masks(frames) { ImageLoss::masked } else { ImageLoss::new };
    Ok(make(Arc::clone(device))?)
}

/// Figures of a step.
struct Figures {
    /// None before the first loss.
    sums: Option<LossSums>,
    /// As [`FigureBuffers::counts`].
    counts: Option<Vec<u32>>,
    /// As [`FigureBuffers::bits`].
    bits: Option<Vec<f32>>,
}

/// Where a run stops.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Goal {
    /// At [`Schedule::fork_step`].
    Fork,
    /// At the last step.
    End,
}

struct Run {
    device: Arc<Device>,
    schedule: Schedule,
    /// What was chosen for the dataset and the machine.
    choices: Choices,
    /// Where the scene's coordinates are in the world.
    frame: SceneFrame,
    /// The training photographs, with cameras in the frame.
    frames: Vec<Frame>,
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
    /// Gaussians of the last view that was rendered; none before the first.
    gaussians: Option<usize>,
    batch: Batch,
    /// Batches that were submitted and not settled yet, the first one first.
    flights: VecDeque<Flight>,
    /// Passes of settled batches since the rasterizer's counters were reset.
    settled_passes: usize,
    /// When the last batch was settled, or the first one begun.
    paced: Instant,
    /// Progress of settled steps that is not reported yet.
    news: Vec<Progress>,
    photographs: Photographs,
    /// Color corrections of the photographs, if the run learns them.
    corrections: Option<ColorCorrections>,
    /// Looks at the model, if the run is watched.
    monitor: Option<Monitor>,
}

impl Run {
    /// A run whose color corrections the options or the checkpoint decide without a trial.
    #[cfg(test)]
    fn new(
        device: &Arc<Device>,
        dataset: &Dataset,
        options: &TrainOptions,
        budget: &MemoryBudget,
        resume: Option<Checkpoint>,
    ) -> Result<Self> {
        let exposure = match &resume {
            Some(checkpoint) => checkpoint.exposure(),
            None if options.exposure == Exposure::On => ExposureChoice::ON,
            None => ExposureChoice::OFF,
        };
        Self::with_exposure(device, dataset, options, budget, resume, exposure)
    }

    fn with_exposure(
        device: &Arc<Device>,
        dataset: &Dataset,
        options: &TrainOptions,
        budget: &MemoryBudget,
        resume: Option<Checkpoint>,
        exposure: ExposureChoice,
    ) -> Result<Self> {
        if dataset.split(Split::Train).next().is_none() {
            return Err(TrainError::NoTrainingFrames);
        }
        // A run that began in the world's frame, as those of older versions, ends in it.
        let frame = resume.as_ref().map_or_else(|| scene_frame(dataset), Checkpoint::frame);
        let set = TrainingSet::of(dataset, frame)?;
        let cloud = set.points.as_ref().map_or(0, |points| points.positions.len());
        let mut schedule = Schedule::new(options).in_frame(frame).for_points(cloud == 0);
        let decided = if exposure.corrected { Exposure::On } else { Exposure::Off };
        let decided = TrainOptions { exposure: decided, ..options.clone() };
        let estimate = Needs::of(dataset, &decided, device.adapter()).within(budget)?;
        estimate.log();
        let preset_size = schedule.max_size();
        warn_if_capped(preset_size, &estimate);
        let adapter = device.adapter_line();
        let max_size = estimate.size;
        let identity = RunIdentity { options, dataset: dataset.digest, adapter: &adapter, max_size };
        let corrections = exposure.corrected.then(|| ColorCorrections::new(device, set.frames.len()));
        let corrections = corrections.transpose()?;
        let (state, model) = match resume {
            Some(checkpoint) => {
                let (mut state, mut saved) = checkpoint.open(identity, schedule.steps, set.frames.len())?;
                tracing::info!(step = state.step, "resuming from step {}", state.step);
                state.continue_on(&adapter, max_size);
                if let Some(corrections) = &corrections {
                    corrections.restore(&mut saved)?;
                }
                schedule.set_max_size(state.max_size);
                let factory = ModelFactory { device, set: &set, schedule: schedule.clone() };
                (state, factory.resume(saved)?)
            }
            None => {
                let mut rng = Pcg64::seed_from_u64(options.seed);
                let lambda = schedule.lambda();
                schedule.set_max_size(max_size);
                let factory = ModelFactory { device, set: &set, schedule: schedule.clone() };
                let model = factory.create(&mut rng)?;
                (RunState::new(identity, frame, rng, lambda).with_exposure(exposure), model)
            }
        };
        let control = schedule.rate_control(options.max_bytes).map(|control| state.resume_control(control));
        let choices = Choices {
            max_anchors: state.max_size,
            max_anchors_by: if state.max_size < preset_size { SizeBound::Memory } else { SizeBound::Preset },
            points: if cloud > 0 { cloud } else { schedule.random_points },
            random_points: cloud == 0,
            narrowed_from: None,
            exposure: exposure.trial.filter(|_| exposure.corrected),
        };
        let near = NearPlane::of_extent(scene_extent(&set)).depth();
        let settings = RasterSettings { near, ..RasterSettings::default() };
        let now = Instant::now();
        let mut run = Self {
            choices,
            schedule,
            control,
            background: options.background,
            model,
            raster: Rasterizer::new(Arc::clone(device), settings)?,
            loss: loss_of(device, &set.frames)?,
            wavelet: options.has(Component::Wavelet),
            started: now,
            first_step: state.step,
            reported: (now, state.step),
            gaussians: None,
            // The first batch is one step: it compiles kernels and allocates buffers.
            batch: Batch::Timed { seconds_per_step: 1.0 },
            flights: VecDeque::new(),
            settled_passes: 0,
            paced: now,
            news: Vec::new(),
            photographs: Photographs::new(device, &set.frames, options.background, estimate.photographs),
            state,
            device: Arc::clone(device),
            frame,
            frames: set.frames,
            corrections,
            monitor: None,
        };
        run.tell_of_masks()?;
        Ok(run)
    }

    /// Tells the model if some pixels of the photographs do not count.
    fn tell_of_masks(&mut self) -> Result<()> {
        if has_masks(&self.frames) { self.model.count_views_with_gradient() } else { Ok(()) }
    }

    /// The last step on the way to `goal`.
    fn last(&self, goal: Goal) -> u32 {
        match goal {
            Goal::Fork => self.schedule.fork_step(),
            Goal::End => self.schedule.steps,
        }
    }

    /// Runs the steps up to `goal`.
    fn run_until(
        &mut self,
        goal: Goal,
        sink: Option<&mut dyn CheckpointSink>,
        report: &mut dyn FnMut(&Progress),
        cancel: &CancelFlag,
    ) -> Result<()> {
        let mut writer = CheckpointWriter { sink, saved_step: self.state.step };
        if self.state.step > 0 {
            writer.keep_first(self);
            let figures = self.read_figures()?;
            let progress = self.progress(self.state.step, &figures);
            report(&writer.with_checkpoint_step(progress));
        }
        while self.state.step < self.last(goal) {
            if cancel.is_cancelled() {
                // Steps that overflowed are not repeated: the checkpoint is of the last one before them.
                self.settle(0)?;
                writer.save(self);
                return Err(TrainError::Cancelled);
            }
            let last = self.last(goal);
            let looks = self.monitor.as_ref().is_some_and(Monitor::is_due);
            self.advance(&mut |step| looks || step == last || writer.wants(step), cancel)?;
            let step = self.state.step;
            if self.flights.is_empty() && (looks || step == self.schedule.steps) {
                self.look()?;
            }
            if self.flights.is_empty() {
                // Before the report, which states its step. A run that is cancelled in a long pause goes on from the step before it.
                if writer.wants(step) || self.schedule.pauses_after(step + 1) || step == self.last(goal) {
                    writer.save(self);
                }
            }
            for progress in std::mem::take(&mut self.news) {
                report(&writer.with_checkpoint_step(self.as_seen(progress)));
            }
        }
        Ok(())
    }

    /// Looks at the model. Nothing may be in flight.
    fn look(&mut self) -> Result<()> {
        let step = self.at(self.state.step);
        let is_last = self.state.step == self.schedule.steps;
        match &mut self.monitor {
            Some(monitor) => monitor.look(&mut *self.model, &mut self.raster, &step, is_last),
            None => Ok(()),
        }
    }

    /// The report with what was seen of the model.
    fn as_seen(&mut self, progress: Progress) -> Progress {
        match &mut self.monitor {
            Some(monitor) => {
                let psnr = monitor.psnr().or(progress.psnr);
                Progress { psnr, preview: monitor.take_preview(), ..progress }
            }
            None => progress,
        }
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
        Step {
            number,
            fraction: self.schedule.fraction(number),
            lambda: self.state.lambda(),
            size_aim: self.control.as_ref().map(RateControl::aim),
        }
    }

    /// Submits a batch of steps: up to the next one that the host has to act after, or that `wanted` names. Settles the batch before it,
    /// and this one too if the host has to act after it.
    ///
    /// Nothing is read back within a batch. If a pass overflowed its buffer of intersections, it and the passes after it changed
    /// nothing, and are repeated with a larger buffer. Returns the number of recorded steps, repeated ones included.
    fn advance(&mut self, wanted: &mut dyn FnMut(u32) -> bool, cancel: &CancelFlag) -> Result<u32> {
        let mut recorded = 0;
        loop {
            let (last, steps, pauses) = self.submit_batch(wanted)?;
            recorded += steps;
            if !self.settle(if pauses { 0 } else { 1 })? {
                continue;
            }
            if pauses {
                if self.model.adapts(&last) {
                    if let Some(next) = self.model.successor(&last, &mut self.state.rng)? {
                        self.model = next;
                    }
                    let (model, rng, mut views) = self.model_and_views(cancel);
                    model.adapt(&last, rng, &mut views)?;
                    // It may have another renderer now.
                    self.tell_of_masks()?;
                }
                if self.reports_after(last.number) {
                    let figures = self.read_figures()?;
                    self.take_figures(last.number, &figures)?;
                }
            }
            return Ok(recorded);
        }
    }

    /// The model, the run's random numbers, and the training views with what renders and compares them.
    fn model_and_views<'a>(
        &'a mut self,
        cancel: &'a CancelFlag,
    ) -> (&'a mut dyn ModelTrainer, &'a mut Pcg64, Views<'a>) {
        let views = Views {
            raster: &mut self.raster,
            frames: &self.frames,
            photographs: &mut self.photographs,
            corrections: self.corrections.as_ref(),
            background: self.background,
            cancel,
        };
        (&mut *self.model, &mut self.state.rng, views)
    }

    /// Records and submits the steps of a batch; returns the last one, their number, and whether the host has to act after it.
    fn submit_batch(&mut self, wanted: &mut dyn FnMut(u32) -> bool) -> Result<(Step, u32, bool)> {
        if self.flights.is_empty() {
            // Passes between steps have counted too.
            self.raster.reset_forward_passes();
            (self.settled_passes, self.paced) = (0, Instant::now());
        }
        let max_steps = self.batch.length();
        let mut before = Vec::new();
        loop {
            before.push(self.state.clone());
            let steps = before.len();
            let reading = self.record(&mut |run, step| {
                let pauses = run.pauses_after(step) || wanted(step.number);
                let ends = pauses || run.reports_after(step.number) || steps >= max_steps;
                ends.then_some(pauses)
            })?;
            if let Some((last, pauses, reading)) = reading {
                let steps = before.len() as u32;
                let is_reported = !pauses && self.reports_after(last.number);
                let losses = self.loss.partial_sums();
                self.flights.push_back(Flight { before, last: last.number, is_reported, losses, reading });
                return Ok((last, steps, pauses));
            }
        }
    }

    /// Whether progress is reported after a step.
    fn reports_after(&self, step: u32) -> bool {
        step.is_multiple_of(REPORT_INTERVAL) || step == self.schedule.steps
    }

    /// Whether the host has to act on the state after a step, before the next one.
    fn pauses_after(&self, step: &Step) -> bool {
        step.number == self.schedule.steps
            || self.model.adapts(step)
            || self.schedule.pauses_after(step.number + 1)
            // The report changes lambda.
            || (self.control.is_some() && self.reports_after(step.number))
    }

    /// Waits for batches until `left` are in flight. Returns false if a pass had overflowed: the state is then the one before that
    /// step, and nothing is in flight.
    fn settle(&mut self, left: usize) -> Result<bool> {
        while self.flights.len() > left {
            let Some(flight) = self.flights.pop_front() else { break };
            let Flight { mut before, last, is_reported, losses, reading } = flight;
            let steps = before.len();
            let read = reading.wait(&self.device)?;
            let passes = self.raster.forward_passes(&read[0]);
            let now = Instant::now();
            self.batch.update(steps as u32, (now - self.paced).as_secs_f64());
            self.paced = now;
            if let Some(needed) = passes.required {
                let first = (passes.completed as usize).saturating_sub(self.settled_passes).min(steps - 1);
                tracing::debug!(step = before[first].step + 1, needed, "no room for all intersections");
                self.state = before.swap_remove(first);
                self.flights.clear();
                self.raster.reserve(needed)?;
                return Ok(false);
            }
            self.settled_passes += steps;
            if is_reported {
                let figures = self.figures_of(losses, &read[1..]);
                self.take_figures(last, &figures)?;
            }
        }
        Ok(true)
    }

    /// Records and submits one step. If `ends` says that a batch ends with it, and whether the host has to act after it, the outcome of
    /// the passes so far is on its way back, with the step's figures if they are reported without a pause.
    fn record(
        &mut self,
        ends: &mut dyn FnMut(&Self, &Step) -> Option<bool>,
    ) -> Result<Option<(Step, bool, Readback)>> {
        reach(FailurePoint::Step);
        let step = self.at(self.state.step + 1);
        let index = self.next_frame();
        let camera = self.frames[index].camera;
        self.photographs.prepare(self.state.order.iter().rev().copied());
        let device = Arc::clone(&self.device);
        let mut recorder = device.recorder(STEP_RECORDING);
        recorder.stage("photograph");
        let photograph = self.photographs.bring(&mut recorder, index)?;
        recorder.stage("model forward");
        self.model.forward(&mut recorder, &camera, &step)?;
        let is_long = is_long(&device, self.model.gaussians().capacity, &camera);
        let next_stage = |recorder: &mut Recorder<'_>, name| {
            recorder.stage(name);
            if is_long { recorder.flush() } else { Ok(()) }
        };
        next_stage(&mut recorder, "rasterizer forward")?;
        self.raster.forward(&mut recorder, self.model.gaussians(), &camera, self.background.rgb())?;
        next_stage(&mut recorder, "loss")?;
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        let pixels = size[0] as usize * size[1] as usize;
        let counted = self.frames[index].mask.as_ref().map_or(pixels, |mask| mask.counted() as usize);
        let wavelet = self.wavelet.then(|| WaveletWeights::at(step.fraction));
        let photograph = (&photograph, counted);
        let render = self.raster.image();
        let corrections = self.corrections.as_mut();
        let corrected =
            corrections.map(|all| all.correct(&mut recorder, index, render, pixels)).transpose()?;
        let seen = corrected.as_ref().unwrap_or(render);
        let d_image = self.loss.record_counted(&mut recorder, size, seen, photograph, wavelet.as_ref())?;
        if let Some(corrections) = &mut self.corrections {
            let learning = Learning::at(step.number, self.schedule.steps, index, self.frames.len());
            let overflow_flag = self.raster.overflow_flag();
            corrections.learn(&mut recorder, learning, render, d_image, overflow_flag)?;
        }
        let gaussians = self.model.gaussians().clone();
        let d_gaussians = self.model.gaussian_gradients()?;
        next_stage(&mut recorder, "rasterizer backward")?;
        self.raster.backward(&mut recorder, &gaussians, &camera, d_image, &d_gaussians)?;
        next_stage(&mut recorder, "model backward")?;
        self.model.backward(&mut recorder, &step, self.raster.overflow_flag())?;
        self.state.step = step.number;
        let step = self.at(step.number);
        let Some(pauses) = ends(self, &step) else {
            recorder.submit()?;
            return Ok(None);
        };
        let figures =
            if !pauses && self.reports_after(step.number) { self.figure_buffers() } else { Vec::new() };
        let buffers: Vec<Binding<'_>> = std::iter::once(self.raster.overflow_flag() as Binding<'_>)
            .chain(figures.iter().map(|buffer| &**buffer))
            .collect();
        Ok(Some((step, pauses, recorder.submit_reading(&buffers)?)))
    }

    /// Where the figures of the last step are: losses, then what the model has of counts and bits.
    fn figure_buffers(&self) -> Vec<Box<dyn AsRef<RawBuffer>>> {
        let FigureBuffers { counts, bits } = self.model.figures();
        let mut buffers: Vec<Box<dyn AsRef<RawBuffer>>> = Vec::new();
        if let Some(partial) = self.loss.partial_sums() {
            buffers.push(Box::new(partial.sums));
        }
        buffers.extend(counts.map(|counts| Box::new(counts) as _));
        buffers.extend(bits.map(|bits| Box::new(bits) as _));
        buffers
    }

    /// The figures in copies of [`Self::figure_buffers`], of a step whose losses are in `losses`.
    fn figures_of(&self, losses: Option<PartialSums>, copies: &[Vec<u32>]) -> Figures {
        let FigureBuffers { counts, bits } = self.model.figures();
        let mut copies = copies.iter();
        let sums = losses.and_then(|partial| {
            Some(partial.total(bytemuck::try_cast_slice(copies.next()?).unwrap_or_default()))
        });
        let counts = counts.and_then(|_| copies.next().cloned());
        let bits = bits.and_then(|_| Some(bytemuck::cast_slice(copies.next()?).to_vec()));
        Figures { sums, counts, bits }
    }

    /// The figures of the last submitted step. Waits for the device.
    fn read_figures(&self) -> Result<Figures> {
        let buffers = self.figure_buffers();
        let buffers: Vec<Binding<'_>> = buffers.iter().map(|buffer| &**buffer).collect();
        let reading = self.device.recorder("figures").submit_reading(&buffers)?;
        Ok(self.figures_of(self.loss.partial_sums(), &reading.wait(&self.device)?))
    }

    /// Updates averages, the estimate of the file's size, and lambda by the figures of `step`, and adds its report to the news.
    fn take_figures(&mut self, step: u32, figures: &Figures) -> Result<()> {
        let diverged = TrainError::Diverged { step };
        let sums = figures.sums.filter(|sums| sums.loss().is_finite()).ok_or(diverged)?;
        let sample = match &figures.bits {
            Some(bits) => self.model.bitrate(step, bits)?,
            None => None,
        };
        let anchors = self.model.anchors() as f64;
        // Steps in flight began from states without these figures.
        let later = self.flights.iter_mut().flat_map(|flight| &mut flight.before);
        for state in std::iter::once(&mut self.state).chain(later) {
            if let Some(BitrateSample { bits_per_anchor, other_bytes }) = sample {
                state.observe_bits(bits_per_anchor, anchors, other_bytes);
            }
            state.observe_losses(&sums);
        }
        if let Some(BitrateSample { other_bytes, .. }) = sample
            && let (Some(control), Some(bytes)) = (&mut self.control, self.state.file_bytes())
        {
            control.observe(step, bytes as f64, other_bytes);
            self.state.set_rate_control(control);
        }
        let progress = self.progress(step, figures);
        self.news.push(progress);
        Ok(())
    }

    /// The progress report of `step`, whose figures these are.
    fn progress(&mut self, step: u32, figures: &Figures) -> Progress {
        let average = self.state.average();
        let steps_per_second = |since: Instant, from: u32| {
            let seconds = since.elapsed().as_secs_f64();
            (step > from && seconds > 0.0).then(|| f64::from(step - from) / seconds)
        };
        let speed = steps_per_second(self.reported.0, self.reported.1);
        let mean_speed = steps_per_second(self.started, self.first_step);
        self.reported = (Instant::now(), step);
        let size = self.model.size(figures.counts.as_deref());
        self.gaussians = size.gaussians.or(self.gaussians);
        Progress {
            step: u64::from(step),
            total: u64::from(self.schedule.steps),
            elapsed_seconds: self.started.elapsed().as_secs_f64(),
            eta_seconds: mean_speed.map(|speed| f64::from(self.schedule.steps - step) / speed),
            steps_per_second: speed,
            anchors: size.anchors as u64,
            gaussians: self.gaussians.unwrap_or(0) as u64,
            loss: average.map(|average| average.loss()),
            psnr: average.map(|average| average.psnr()),
            ssim: average.map(|average| average.ssim),
            bytes: self.state.file_bytes(),
            poses: None,
            checkpoint_step: 0,
            preview: None,
        }
    }

    fn checkpoint(&self) -> Result<Checkpoint> {
        let mut state = self.state.clone();
        state.seconds += self.started.elapsed().as_secs_f64();
        let mut model = self.model.save()?;
        if let Some(corrections) = &self.corrections {
            corrections.save(&mut model)?;
        }
        Ok(Checkpoint::new(state, model))
    }

    fn finish(mut self, cancel: &CancelFlag) -> Result<Trained> {
        let views = &mut Views {
            raster: &mut self.raster,
            frames: &self.frames,
            photographs: &mut self.photographs,
            corrections: self.corrections.as_ref(),
            background: self.background,
            cancel,
        };
        let FinishedModel { scene, unrounded, context } = self.model.finish(views)?;
        let corrections = views.read_corrections()?;
        let corrections = corrections.map(|all| all.into_iter().map(ColorFit::from).collect());
        let scene = scene.in_frame(self.frame);
        let unrounded = unrounded.map(|scene| scene.in_frame(self.frame));
        let seconds = self.state.seconds + self.started.elapsed().as_secs_f64();
        let steps = self.schedule.steps;
        let learnt = self.schedule.shape;
        let is_pruned = matches!(&scene, Scene::Anchors(scene) if ModelShape::of(scene) != learnt);
        let narrowed_from =
            is_pruned.then_some(Widths { features: learnt.features, offsets: learnt.offsets });
        let choices = Choices { narrowed_from, ..self.choices };
        let exposure = self.state.exposure();
        Ok(Trained { scene, unrounded, context, steps, seconds, choices, exposure, corrections })
    }
}

#[cfg(test)]
mod exposure_tests;
#[cfg(test)]
mod measure_tests;
#[cfg(test)]
mod tests;
