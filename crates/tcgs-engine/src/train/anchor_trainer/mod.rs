//! The anchor model in training: features, scalings and offsets of anchors, and the networks that they share.

mod checkpoint;
mod prune_channels;

use std::sync::Arc;

use rand_pcg::Pcg64;

use super::{
    Adam, AdamStep, Decay, DensifySettings, MaskRows, Moments, OffsetMasks, Result, Schedule, Statistics,
    TrainError,
    checkpoint::ModelState,
    compression::Compression,
    densify::{TrainableAnchors, densify, drop_masked},
    model_trainer::{BitrateSample, FigureBuffers, FinishedModel, ModelSize, ModelTrainer, Step, Views},
    prune_invisible::prune_invisible,
    scene_frame::Points,
};
use crate::{
    codec::position_bytes,
    domain::{AnchorScene, Camera, Lattice, NearPlane, Scene, SceneScale},
    gpu::{Buffer, Device, Recorder},
    init::{FirstAnchors, VoxelRule, anchors_from_points, cell_within, initial_rows},
    model::{AnchorRows, ModelShape, NetworkLayout},
    render::{AnchorGradients, DeviceAnchors, GaussianGradients, Gaussians, NeuralGaussians},
};

/// Approximate bytes in a file outside the rate term: the mask of an offset, a parameter of the render networks, and the container.
const BYTES_PER_MASK: f64 = 0.065;
const BYTES_PER_PARAMETER: f64 = 0.85;
const OTHER_BYTES: f64 = 600.0;

/// Anchors and networks with the state of their optimizer and of growth.
pub(super) struct AnchorTrainer {
    device: Arc<Device>,
    schedule: Schedule,
    shape: ModelShape,
    extent: f32,
    layout: NetworkLayout,
    owners: Vec<u8>,
    anchors: AnchorRows,
    /// Bytes of their positions in a file; 0 for the baseline.
    position_bytes: f64,
    device_anchors: DeviceAnchors,
    gradients: AnchorGradients,
    row_moments: Moments,
    network_moments: Moments,
    statistics: Buffer<f32>,
    /// While they learn.
    masks: Option<OffsetMasks>,
    /// None for the baseline.
    compression: Option<Compression>,
    /// The quantized anchors of the last forward pass, if it rendered those.
    shown: Option<DeviceAnchors>,
    /// Whether `neural` has rendered a view.
    rendered: bool,
    neural: NeuralGaussians,
    adam: Adam,
}

/// The parts of a trainer that a checkpoint restores.
struct Parts {
    state: TrainableAnchors,
    statistics: Statistics,
    /// The networks' parameters and their moments.
    networks: [Vec<f32>; 3],
    compression: Option<Compression>,
}

/// Bytes of the anchors' positions in a file: 0 for the baseline, and where they cannot be written, which the encoder will say.
fn position_bytes_of(anchors: &AnchorRows, compression: Option<&Compression>) -> f64 {
    compression.and_then(|_| position_bytes(&anchors.cells).ok()).map_or(0.0, |bytes| bytes as f64)
}

/// Warns of points that the lattice leaves out, and of cells larger than by the rule.
fn warn_of_lattice(lattice: &Lattice, points: &[[f32; 3]], rule: VoxelRule) {
    let strays = points.iter().filter(|point| cell_within(lattice, **point).is_none()).count();
    if strays > 0 {
        tracing::warn!("{strays} of {} points are too far from the others to begin from", points.len());
    }
    if let VoxelRule::Fixed(edge) = rule
        && lattice.voxel > edge
    {
        let times = lattice.voxel / edge;
        tracing::warn!(
            "cells of the edge that was given do not reach across the points; they are {times} times as large"
        );
    }
}

impl AnchorTrainer {
    /// A trainer with anchors at the cloud's points and newly initialized networks; `extent` is the scene's, in units of its frame.
    pub(super) fn new(
        device: &Arc<Device>,
        schedule: Schedule,
        Points { positions, colors }: &Points,
        extent: f32,
        rng: &mut Pcg64,
    ) -> Result<Self> {
        let shape = schedule.shape;
        let rule = schedule.voxel.for_points(positions, extent);
        // Half the limit is left for growth.
        let max = schedule.max_anchors / 2;
        let first = if schedule.begins_colored {
            anchors_from_points(positions, colors, rule, shape, max, rng)?
        } else {
            let anchors = initial_rows(positions, rule, shape, max)?;
            FirstAnchors { anchors, networks: NetworkLayout::new(shape).initial(rng) }
        };
        warn_of_lattice(&first.anchors.lattice, positions, rule);
        Self::begin(device, schedule, first, extent)
    }

    /// A trainer with these anchors and networks; the rest as in [`Self::new`].
    pub(super) fn begin(
        device: &Arc<Device>,
        schedule: Schedule,
        first: FirstAnchors,
        extent: f32,
    ) -> Result<Self> {
        let FirstAnchors { anchors, networks } = first;
        let (shape, parameters) = (anchors.shape, networks.len());
        let zeros = |len| vec![0.0; len];
        let compression = schedule.compression.clone();
        let parts = Parts {
            networks: [networks, zeros(parameters), zeros(parameters)],
            compression: compression.map(|schedule| Compression::new(device, schedule, shape)),
            statistics: Statistics::zero(shape, anchors.len()),
            state: TrainableAnchors {
                first: zeros(anchors.values.len()),
                second: zeros(anchors.values.len()),
                masks: schedule.masks.map(|_| MaskRows::new(anchors.len() * shape.offsets)),
                anchors,
            },
        };
        Self::assemble(device, schedule, extent, parts)
    }

    fn assemble(device: &Arc<Device>, schedule: Schedule, extent: f32, parts: Parts) -> Result<Self> {
        let Parts { state, statistics, networks: [networks, first, second], compression } = parts;
        let shape = state.anchors.shape;
        let near = NearPlane::of_extent(extent).depth();
        let TrainableAnchors { anchors, .. } = &state;
        let masks = state.masks.as_ref().map(|masks| OffsetMasks::upload(device, shape, masks));
        let layout = NetworkLayout::new(shape);
        Ok(Self {
            schedule,
            shape,
            extent,
            owners: layout.owners(),
            device_anchors: DeviceAnchors::upload(device, anchors, &networks)?,
            gradients: AnchorGradients::plan(shape, anchors.len()).make(device)?,
            row_moments: Moments::upload(device, &state.first, &state.second)?,
            network_moments: Moments::upload(device, &first, &second)?,
            statistics: device.upload("growth statistics", &statistics.values)?,
            masks: masks.transpose()?,
            position_bytes: position_bytes_of(anchors, compression.as_ref()),
            compression,
            shown: None,
            rendered: false,
            neural: NeuralGaussians::new(Arc::clone(device), shape, near, SceneScale::DEFAULT)?,
            adam: Adam::new(device)?,
            device: Arc::clone(device),
            layout,
            anchors: state.anchors,
        })
    }

    fn row_learning_rates(&self, fraction: f64) -> Vec<f32> {
        let mut rates = vec![self.schedule.feature.at(fraction) as f32; self.shape.row()];
        rates[self.shape.scaling_column()..].fill(self.schedule.scaling.at(fraction) as f32);
        rates[self.shape.offset_column()..].fill(self.schedule.offset.at(fraction) as f32 * self.extent);
        rates
    }

    fn network_learning_rates(&self, fraction: f64) -> Vec<f32> {
        let rates = self.schedule.networks.map(|decay: Decay| decay.at(fraction) as f32);
        self.owners.iter().map(|owner| rates[usize::from(*owner)]).collect()
    }

    fn densify(&mut self, step: &Step, rng: &mut Pcg64) -> Result<()> {
        let (mut state, mut statistics) = self.read()?;
        let settings = DensifySettings {
            threshold: self.schedule.growth_threshold_at(step.number, step.lambda),
            min_views: 0.4 * self.schedule.densify_every as f32,
            min_visits: 0.8 * self.schedule.densify_every as f32,
            coarsest: self.schedule.coarsest_growth.into(),
            max_anchors: self.schedule.max_anchors,
            extent: self.extent,
        };
        let outcome = densify(&mut state, &mut statistics, &settings, rng);
        tracing::debug!(
            step = step.number,
            grown = outcome.grown,
            pruned = outcome.pruned,
            anchors = state.anchors.len()
        );
        self.write(state, &statistics, step.number)
    }

    fn fixes_masks(&self, step: u32) -> bool {
        self.schedule.masks.is_some_and(|masks| masks.until == step)
    }

    /// Ends the masks' learning and prunes anchors that keep no offset that is visible in `views`.
    fn fix_masks(&mut self, step: u32, views: &Views<'_>) -> Result<()> {
        let (mut state, mut statistics) = self.read()?;
        state.masks = None;
        self.prune_invisible(step, &mut state.anchors, views)?;
        let dropped = drop_masked(&mut state, &mut statistics);
        tracing::debug!(step, dropped, anchors = state.anchors.len(), "masks fixed");
        self.write(state, &statistics, step)
    }

    /// Prunes anchors that are invisible in all `views` after `step`, before context models are selected for the remaining ones.
    fn prune_invisible_anchors(&mut self, step: u32, views: &Views<'_>) -> Result<()> {
        let (mut state, mut statistics) = self.read()?;
        self.prune_invisible(step + 1, &mut state.anchors, views)?;
        let dropped = drop_masked(&mut state, &mut statistics);
        tracing::debug!(step, dropped, anchors = state.anchors.len(), "invisible anchors pruned");
        self.write(state, &statistics, step)
    }

    /// Masks the offsets of `anchors`, those on the device, that are invisible in all `views` as rendered at `step`.
    fn prune_invisible(&mut self, step: u32, anchors: &mut AnchorRows, views: &Views<'_>) -> Result<()> {
        if !self.schedule.prunes_invisible {
            return Ok(());
        }
        let mut recorder = self.device.recorder("anchors as rendered");
        let shown = match &self.compression {
            Some(compression) => compression.forward(&mut recorder, &self.device_anchors, step)?,
            None => None,
        };
        recorder.submit()?;
        let shown = shown.as_ref().unwrap_or(&self.device_anchors);
        prune_invisible(&self.device, &mut self.neural, shown, anchors, views)
    }

    /// Approximate bytes of the file without attributes and context model.
    fn fixed_bytes(&self) -> f64 {
        let masks = BYTES_PER_MASK * (self.anchors.len() * self.shape.offsets) as f64;
        let networks = BYTES_PER_PARAMETER * self.layout.parameters as f64;
        OTHER_BYTES + self.position_bytes + masks + networks
    }

    /// Reads back everything that belongs to anchors.
    fn read(&self) -> Result<(TrainableAnchors, Statistics)> {
        let device = &self.device;
        let mut anchors = self.anchors.clone();
        anchors.values = device.read(&self.device_anchors.rows)?;
        anchors.masks = device.read(&self.device_anchors.masks)?;
        let state = TrainableAnchors {
            anchors,
            first: device.read(&self.row_moments.first)?,
            second: device.read(&self.row_moments.second)?,
            masks: self.masks.as_ref().map(|masks| masks.read(device)).transpose()?,
        };
        Ok((state, Statistics { shape: self.shape, values: device.read(&self.statistics)? }))
    }

    fn write(&mut self, state: TrainableAnchors, statistics: &Statistics, step: u32) -> Result<()> {
        if state.anchors.is_empty() {
            return Err(TrainError::NothingLeft { step });
        }
        let device = &self.device;
        let networks = device.read(&self.device_anchors.networks)?;
        self.device_anchors = DeviceAnchors::upload(device, &state.anchors, &networks)?;
        self.row_moments = Moments::upload(device, &state.first, &state.second)?;
        self.gradients = AnchorGradients::plan(self.shape, state.anchors.len()).make(device)?;
        self.statistics = device.upload("growth statistics", &statistics.values)?;
        self.masks = state.masks.map(|masks| OffsetMasks::upload(device, self.shape, &masks)).transpose()?;
        if let Some(compression) = &mut self.compression {
            compression.replace(&self.anchors.cells, &state.anchors)?;
        }
        self.shown = None;
        self.position_bytes = position_bytes_of(&state.anchors, self.compression.as_ref());
        self.anchors = state.anchors;
        Ok(())
    }
}

impl ModelTrainer for AnchorTrainer {
    fn forward(&mut self, recorder: &mut Recorder<'_>, camera: &Camera, step: &Step) -> Result<()> {
        self.shown = match &self.compression {
            Some(compression) => compression.forward(recorder, &self.device_anchors, step.number)?,
            None => None,
        };
        let shown = self.shown.as_ref().unwrap_or(&self.device_anchors);
        self.neural.forward(recorder, shown, camera, self.schedule.volume_weight)?;
        self.rendered = true;
        Ok(())
    }

    fn gaussians(&self) -> &Gaussians {
        self.neural.gaussians()
    }

    fn gaussian_gradients(&mut self) -> Result<GaussianGradients> {
        Ok(self.neural.gaussian_gradients()?.clone())
    }

    fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        step: &Step,
        overflow_flag: &Buffer<u32>,
    ) -> Result<()> {
        let shown = self.shown.as_ref().unwrap_or(&self.device_anchors);
        self.neural.backward(recorder, shown, &self.gradients)?;
        if self.schedule.gathers_statistics(step.number) {
            self.neural.statistics(recorder, shown, &self.statistics, overflow_flag)?;
        }
        if let Some(compression) = &mut self.compression {
            let d_rows = &self.gradients.rows;
            recorder.stage("context model");
            compression.backward(recorder, &self.adam, &self.device_anchors, step, d_rows, overflow_flag)?;
        }
        recorder.stage("optimizer");
        let rows = recorder.uniform(&self.row_learning_rates(step.fraction))?;
        let networks = recorder.uniform(&self.network_learning_rates(step.fraction))?;
        let (adam, anchors, gradients) = (&self.adam, &self.device_anchors, &self.gradients);
        // Moments begin with the anchors. A checkpoint of another program may have anchors from the run's first step on.
        let number = step.number.saturating_sub(self.schedule.plain_until).max(1);
        let adam_step = AdamStep { number, overflow_flag };
        adam.step(recorder, adam_step, &rows, &gradients.rows, &anchors.rows, &self.row_moments)?;
        let moments = &self.network_moments;
        adam.step(recorder, adam_step, &networks, &gradients.networks, &anchors.networks, moments)?;
        if let (Some(masks), Some(schedule)) = (&self.masks, &self.schedule.masks)
            && schedule.learns(step.number)
        {
            recorder.stage("masks");
            masks.backward(
                recorder,
                &mut self.neural,
                anchors,
                schedule.weight_at(step.number, step.lambda),
            )?;
            if let Some(compression) = &self.compression {
                compression.mask_backward(recorder, masks, step.lambda)?;
            }
            let learning_rate = schedule.learning_rate.at(step.fraction) as f32;
            let mask_step = AdamStep { number: step.number + 1 - schedule.from, overflow_flag };
            masks.step(recorder, adam, mask_step, learning_rate, schedule.level, anchors)?;
        }
        Ok(())
    }

    fn count_views_with_gradient(&mut self) -> Result<()> {
        Ok(self.neural.count_views_with_gradient()?)
    }

    fn adapts(&self, step: &Step) -> bool {
        let changes_stage =
            self.compression.as_ref().is_some_and(|compression| compression.changes_stage_after(step.number));
        self.schedule.densifies(step.number)
            || self.fixes_masks(step.number)
            || self.schedule.channel_pruning_estimates.contains(&step.number)
            || changes_stage
    }

    fn adapt(&mut self, step: &Step, rng: &mut Pcg64, views: &mut Views<'_>) -> Result<()> {
        if self.schedule.densifies(step.number) {
            self.densify(step, rng)?;
        }
        if self.fixes_masks(step.number) {
            self.fix_masks(step.number, views)?;
        }
        if self.schedule.channel_pruning_estimates.contains(&step.number) {
            self.estimate_channel_pruning(views)?;
        }
        if self.compression.as_ref().is_some_and(|compression| compression.starts_rounding_after(step.number))
        {
            self.prune_invisible_anchors(step.number, views)?;
            if self.schedule.prunes_channels {
                self.prune_channels(step.number, views)?;
            }
        }
        if self.compression.as_ref().is_some_and(|compression| compression.changes_stage_after(step.number)) {
            let (state, _) = self.read()?;
            let limit = step.size_aim.map(|aim| aim.limit(self.fixed_bytes()));
            if let Some(compression) = &mut self.compression {
                compression.enter_stage(
                    step.number,
                    &self.adam,
                    &state.anchors,
                    &self.device_anchors,
                    limit,
                    views.cancel,
                )?;
            }
        }
        Ok(())
    }

    fn anchors(&self) -> usize {
        self.anchors.len()
    }

    fn figures(&self) -> FigureBuffers {
        FigureBuffers {
            counts: self.rendered.then(|| self.neural.gaussians().count.clone()),
            bits: self.compression.as_ref().and_then(Compression::sampled_bits),
        }
    }

    fn size(&self, counts: Option<&[u32]>) -> ModelSize {
        ModelSize { anchors: self.anchors.len(), gaussians: counts.map(|counts| counts[1] as usize) }
    }

    fn bitrate(&self, step: u32, bits: &[f32]) -> Result<Option<BitrateSample>> {
        let bitrate = match &self.compression {
            Some(compression) => compression.bitrate(step, bits)?,
            None => None,
        };
        Ok(bitrate.map(|(bits_per_anchor, context_bytes)| BitrateSample {
            bits_per_anchor,
            other_bytes: self.fixed_bytes() + context_bytes,
        }))
    }

    fn save(&self) -> Result<ModelState> {
        self.to_state()
    }

    fn finish(mut self: Box<Self>, views: &mut Views<'_>) -> Result<FinishedModel> {
        let before = self.anchors.cells.clone();
        let mut anchors = self.anchors.clone();
        anchors.values = self.device.read(&self.device_anchors.rows)?;
        anchors.masks = self.device.read(&self.device_anchors.masks)?;
        let networks = self.device.read(&self.device_anchors.networks)?;
        self.prune_invisible(self.schedule.steps, &mut anchors, views)?;
        anchors.drop_empty();
        if anchors.is_empty() {
            return Err(TrainError::NothingLeft { step: self.schedule.steps });
        }
        let trained = anchors.clone();
        let context = match self.compression {
            Some(compression) => {
                compression.finish(&self.adam, &before, &mut anchors, &networks, views.cancel)?
            }
            None => None,
        };
        let near = NearPlane::of_extent(self.extent);
        let scene = |anchors: &AnchorRows| {
            let scene = anchors.to_scene(self.layout.to_networks(&networks));
            Scene::Anchors(AnchorScene { near, ..scene })
        };
        let unrounded = (trained.values != anchors.values).then(|| scene(&trained));
        Ok(FinishedModel { scene: scene(&anchors), unrounded, context })
    }
}
