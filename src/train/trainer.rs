//! The step loop: one photograph a step, forward, loss, backward, Adam, and now and then growth and pruning.

use std::{sync::Arc, time::Instant};

use rand::{SeedableRng, seq::SliceRandom};
use rand_pcg::Pcg64;

use super::{
    Adam, Decay, Densify, ImageLoss, LossSums, Moments, Schedule, Statistics, TrainError,
    densify::{Trainable, densify},
    loss::pack,
    start_box::start_box,
    unused::drop_unused,
};
use crate::{
    domain::{AnchorScene, Background, CancelFlag, Dataset, Frame, Progress, Split, TrainOptions},
    gpu::{Buffer, Context},
    model::{AnchorRows, NetworkLayout, Shape, VoxelRule, initial_rows, random_points},
    render::{AnchorGradients, DeviceAnchors, NeuralGaussians, RasterSettings, Rasterizer},
};

/// Widths of the model that is trained.
const SHAPE: Shape = Shape { features: 32, offsets: 10 };

/// Steps between two reports of progress.
const REPORT_EVERY: u32 = 10;

/// Coarsest growth cell in lattice cells.
const COARSEST_GROWTH: i32 = 16;

/// A finished training run.
#[derive(Debug, Clone)]
pub struct Trained {
    /// The scene, not yet quantised.
    pub scene: AnchorScene,
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
    let mut schedule = Schedule::new(options);
    schedule.max_anchors = schedule.max_anchors.min(NeuralGaussians::most_anchors(context, SHAPE));
    let mut run = Run::begin(context, dataset, options, schedule)?;
    for step in 1..=run.schedule.steps {
        if cancel.is_cancelled() {
            return Err(TrainError::Cancelled);
        }
        run.step(step)?;
        if run.schedule.densifies(step) {
            run.densify(step)?;
        }
        if step.is_multiple_of(REPORT_EVERY) || step == run.schedule.steps {
            report(&run.progress(step)?);
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

struct Run<'a> {
    context: Arc<Context>,
    schedule: Schedule,
    frames: Vec<&'a Frame>,
    background: Background,
    order: Vec<usize>,
    rng: Pcg64,
    extent: f32,
    layout: NetworkLayout,
    owners: Vec<u8>,
    anchors: AnchorRows,
    device: DeviceAnchors,
    gradients: AnchorGradients,
    row_moments: Moments,
    network_moments: Moments,
    statistics: Buffer<f32>,
    neural: NeuralGaussians,
    raster: Rasterizer,
    loss: ImageLoss,
    adam: Adam,
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
        schedule: Schedule,
    ) -> Result<Self, TrainError> {
        let frames: Vec<&Frame> = dataset.split(Split::Train).collect();
        if frames.is_empty() {
            return Err(TrainError::NoTrainingFrames);
        }
        let mut rng = Pcg64::seed_from_u64(options.seed);
        let points = match &dataset.points {
            Some(cloud) if !cloud.positions.is_empty() => cloud.positions.clone(),
            _ => {
                let (low, high) = start_box(dataset.layout, &frames);
                random_points(&mut rng, schedule.random_points, low, high)
            }
        };
        let rule = VoxelRule::OfSpacing(1.0 / COARSEST_GROWTH as f32);
        // Growth needs room above what the points begin with.
        let anchors = initial_rows(&points, rule, SHAPE, schedule.max_anchors / 2)?;
        let layout = NetworkLayout::new(SHAPE);
        let networks = layout.initial(&mut rng);
        let now = Instant::now();
        Ok(Self {
            schedule,
            background: options.background,
            order: Vec::new(),
            rng,
            extent: camera_extent(&frames),
            owners: layout.owners(),
            device: DeviceAnchors::upload(context, &anchors, &networks)?,
            gradients: AnchorGradients::new(context, SHAPE, anchors.len())?,
            row_moments: Moments::zero(context, anchors.values.len())?,
            network_moments: Moments::zero(context, layout.parameters)?,
            statistics: context.buffer("growth statistics", anchors.len() * Statistics::width(SHAPE))?,
            neural: NeuralGaussians::new(Arc::clone(context), SHAPE, RasterSettings::default().near)?,
            raster: Rasterizer::new(Arc::clone(context), RasterSettings::default())?,
            loss: ImageLoss::new(Arc::clone(context))?,
            adam: Adam::new(context)?,
            began: now,
            recent: Recent { since: now, step: 0, average: None },
            context: Arc::clone(context),
            frames,
            layout,
            anchors,
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

    fn step(&mut self, step: u32) -> Result<(), TrainError> {
        let index = self.next_frame();
        let camera = self.frames[index].camera;
        let context = Arc::clone(&self.context);
        loop {
            let mut recorder = context.recorder("forward");
            self.neural.forward(&mut recorder, &self.device, &camera, self.schedule.volume_weight)?;
            self.raster.forward(&mut recorder, self.neural.gaussians(), &camera, self.background.rgb())?;
            recorder.submit()?;
            let counts = self.raster.counts()?;
            if !counts.overflowed {
                break;
            }
            self.raster.grow(&counts)?;
        }
        // Packed when it is needed: a second copy of every image would double what a dataset takes.
        let photograph = pack(self.frames[index].image.over(self.background.rgb8()).samples());
        let mut recorder = context.recorder("backward");
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        let v_image = self.loss.record(&mut recorder, size, self.raster.image(), &photograph, None)?;
        let gaussians = self.neural.gaussians().clone();
        let d_gaussians = self.neural.gaussian_gradients()?.clone();
        self.raster.backward(&mut recorder, &gaussians, &camera, v_image, &d_gaussians)?;
        self.neural.backward(&mut recorder, &self.device, &self.gradients)?;
        if self.schedule.gathers_statistics(step) {
            self.neural.statistics(&mut recorder, &self.device, &self.statistics)?;
        }
        let fraction = self.schedule.fraction(step);
        let row_rates = recorder.uniform(&self.row_rates(fraction))?;
        let network_rates = recorder.uniform(&self.network_rates(fraction))?;
        self.adam.step(
            &mut recorder,
            step,
            &row_rates,
            &self.gradients.rows,
            &self.device.rows,
            &self.row_moments,
        )?;
        self.adam.step(
            &mut recorder,
            step,
            &network_rates,
            &self.gradients.networks,
            &self.device.networks,
            &self.network_moments,
        )?;
        recorder.submit()?;
        Ok(())
    }

    fn row_rates(&self, fraction: f64) -> Vec<f32> {
        let mut rates = vec![self.schedule.feature.at(fraction) as f32; SHAPE.row()];
        rates[SHAPE.scaling_column()..].fill(self.schedule.scaling.at(fraction) as f32);
        rates[SHAPE.offset_column()..].fill(self.schedule.offset.at(fraction) as f32 * self.extent);
        rates
    }

    fn network_rates(&self, fraction: f64) -> Vec<f32> {
        let rates = self.schedule.networks.map(|decay: Decay| decay.at(fraction) as f32);
        self.owners.iter().map(|owner| rates[usize::from(*owner)]).collect()
    }

    fn densify(&mut self, step: u32) -> Result<(), TrainError> {
        let context = Arc::clone(&self.context);
        self.anchors.values = context.read(&self.device.rows)?;
        let mut state = Trainable {
            anchors: self.anchors.clone(),
            first: context.read(&self.row_moments.first)?,
            second: context.read(&self.row_moments.second)?,
        };
        let mut statistics = Statistics { shape: SHAPE, values: context.read(&self.statistics)? };
        let settings = Densify {
            threshold: self.schedule.growth_threshold,
            min_views: 0.4 * self.schedule.densify_every as f32,
            min_visits: 0.8 * self.schedule.densify_every as f32,
            coarsest: COARSEST_GROWTH,
            max_anchors: self.schedule.max_anchors,
            extent: self.extent,
        };
        let outcome = densify(&mut state, &mut statistics, &settings, &mut self.rng);
        tracing::debug!(step, grown = outcome.grown, pruned = outcome.pruned, anchors = state.anchors.len());
        if state.anchors.is_empty() {
            return Err(TrainError::NothingLeft { step });
        }
        let networks = context.read(&self.device.networks)?;
        self.device = DeviceAnchors::upload(&context, &state.anchors, &networks)?;
        self.row_moments = Moments::upload(&context, &state.first, &state.second)?;
        self.gradients = AnchorGradients::new(&context, SHAPE, state.anchors.len())?;
        self.statistics = context.upload("growth statistics", &statistics.values)?;
        self.anchors = state.anchors;
        Ok(())
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
        let left = f64::from(self.schedule.steps - step);
        Ok(Progress {
            step: u64::from(step),
            total: u64::from(self.schedule.steps),
            elapsed_seconds: elapsed,
            eta_seconds: Some(left * elapsed / f64::from(step)),
            steps_per_second: speed,
            anchors: self.anchors.len() as u64,
            gaussians: u64::from(self.neural.counts()?[1]),
            loss: Some(average.loss()),
            psnr: Some(average.psnr()),
        })
    }

    fn finish(mut self, cancel: &CancelFlag) -> Result<Trained, TrainError> {
        self.anchors.values = self.context.read(&self.device.rows)?;
        let networks = self.context.read(&self.device.networks)?;
        drop_unused(&self.context, &mut self.neural, &self.device, &mut self.anchors, &self.frames, cancel)?;
        if self.anchors.is_empty() {
            return Err(TrainError::NothingLeft { step: self.schedule.steps });
        }
        Ok(Trained {
            scene: self.anchors.to_scene(self.layout.to_networks(&networks)),
            steps: self.schedule.steps,
            seconds: self.began.elapsed().as_secs_f64(),
        })
    }
}
