//! The anchor model in training: features, scalings and offsets of anchors, and the networks that they share.

use std::sync::Arc;

use rand_pcg::Pcg64;

use super::{
    Adam, CheckpointError, Decay, Densify, Moments, Schedule, Statistics, TrainError,
    densify::{Trainable, densify},
    learner::{Learner, Size, Step},
    state::LearnerState,
    unused::drop_unused,
};
use crate::{
    domain::{Camera, CancelFlag, Frame, Lattice, Scene},
    gpu::{Buffer, Context, Recorder},
    model::{AnchorRows, MAX_CELL, NetworkLayout, Shape, VoxelRule, initial_rows},
    render::{AnchorGradients, DeviceAnchors, GaussianGradients, Gaussians, NeuralGaussians, RasterSettings},
};

/// Coarsest growth cell in lattice cells.
const COARSEST_GROWTH: i32 = 16;

/// Anchors, networks, and what their optimiser and their growth remember.
pub(super) struct AnchorLearner {
    context: Arc<Context>,
    schedule: Schedule,
    shape: Shape,
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
    adam: Adam,
}

/// What differs between a learner that begins and one that goes on.
struct Parts {
    anchors: AnchorRows,
    networks: Vec<f32>,
    row_moments: Moments,
    network_moments: Moments,
    statistics: Buffer<f32>,
}

/// Anchors that growth does not go beyond on this adapter.
fn most_anchors(context: &Context, schedule: &Schedule) -> usize {
    schedule.max_anchors.min(NeuralGaussians::most_anchors(context, schedule.shape))
}

fn lattice_values(values: &[f32]) -> Result<[f32; 4], CheckpointError> {
    match <[f32; 4]>::try_from(values) {
        Ok(values) if values[0] > 0.0 && values.iter().all(|v| v.is_finite()) => Ok(values),
        _ => Err(CheckpointError::array("lattice", "is not a size and an origin")),
    }
}

impl AnchorLearner {
    /// Anchors at `points` and fresh networks; `extent` is the scene's, in world units.
    pub(super) fn begin(
        context: &Arc<Context>,
        schedule: Schedule,
        points: &[[f32; 3]],
        extent: f32,
        rng: &mut Pcg64,
    ) -> Result<Self, TrainError> {
        let shape = schedule.shape;
        let rule = VoxelRule::OfSpacing(1.0 / COARSEST_GROWTH as f32);
        // Growth needs room above what the points begin with.
        let most = most_anchors(context, &schedule) / 2;
        let anchors = initial_rows(points, rule, shape, most)?;
        let networks = NetworkLayout::new(shape).initial(rng);
        let parts = Parts {
            row_moments: Moments::zero(context, anchors.values.len())?,
            network_moments: Moments::zero(context, networks.len())?,
            statistics: context.buffer("growth statistics", anchors.len() * Statistics::width(shape))?,
            networks,
            anchors,
        };
        Self::assemble(context, schedule, extent, parts)
    }

    /// The learner that [`Learner::save`] was asked of.
    pub(super) fn resume(
        context: &Arc<Context>,
        schedule: Schedule,
        extent: f32,
        mut state: LearnerState,
    ) -> Result<Self, TrainError> {
        let shape = schedule.shape;
        let [voxel, origin @ ..] = lattice_values(&state.take_exactly::<f32>("lattice", 4)?)?;
        let flat: Vec<i32> = state.take("anchors.cells")?;
        let cells: Vec<[i32; 3]> = flat.as_chunks().0.to_vec();
        let anchors = cells.len();
        if anchors == 0
            || flat.len() != 3 * anchors
            || flat.iter().any(|c| c.unsigned_abs() > MAX_CELL as u32)
        {
            let fault = format!("has {} values, or some that are no cell of a lattice", flat.len());
            return Err(CheckpointError::array("anchors.cells", fault).into());
        }
        let rows = anchors * shape.row();
        let parameters = NetworkLayout::new(shape).parameters;
        let mut floats = |name: &str, len: usize| state.take_exactly::<f32>(name, len);
        let values = floats("anchors.rows", rows)?;
        let row_moments = Moments::upload(
            context,
            &floats("anchors.rows.first", rows)?,
            &floats("anchors.rows.second", rows)?,
        )?;
        let networks = floats("networks", parameters)?;
        let network_moments = Moments::upload(
            context,
            &floats("networks.first", parameters)?,
            &floats("networks.second", parameters)?,
        )?;
        let statistics = floats("growth", anchors * Statistics::width(shape))?;
        let masks = state.take_exactly::<u32>("anchors.masks", anchors)?;
        state.finish()?;
        let parts = Parts {
            anchors: AnchorRows { shape, lattice: Lattice { voxel, origin }, cells, values, masks },
            networks,
            row_moments,
            network_moments,
            statistics: context.upload("growth statistics", &statistics)?,
        };
        Self::assemble(context, schedule, extent, parts)
    }

    fn assemble(
        context: &Arc<Context>,
        mut schedule: Schedule,
        extent: f32,
        parts: Parts,
    ) -> Result<Self, TrainError> {
        let shape = schedule.shape;
        schedule.max_anchors = most_anchors(context, &schedule);
        let Parts { anchors, networks, row_moments, network_moments, statistics } = parts;
        let layout = NetworkLayout::new(shape);
        Ok(Self {
            schedule,
            shape,
            extent,
            owners: layout.owners(),
            device: DeviceAnchors::upload(context, &anchors, &networks)?,
            gradients: AnchorGradients::new(context, shape, anchors.len())?,
            row_moments,
            network_moments,
            statistics,
            neural: NeuralGaussians::new(Arc::clone(context), shape, RasterSettings::default().near)?,
            adam: Adam::new(context)?,
            context: Arc::clone(context),
            layout,
            anchors,
        })
    }

    fn row_rates(&self, fraction: f64) -> Vec<f32> {
        let mut rates = vec![self.schedule.feature.at(fraction) as f32; self.shape.row()];
        rates[self.shape.scaling_column()..].fill(self.schedule.scaling.at(fraction) as f32);
        rates[self.shape.offset_column()..].fill(self.schedule.offset.at(fraction) as f32 * self.extent);
        rates
    }

    fn network_rates(&self, fraction: f64) -> Vec<f32> {
        let rates = self.schedule.networks.map(|decay: Decay| decay.at(fraction) as f32);
        self.owners.iter().map(|owner| rates[usize::from(*owner)]).collect()
    }

    fn densify(&mut self, step: u32, rng: &mut Pcg64) -> Result<(), TrainError> {
        let context = Arc::clone(&self.context);
        self.anchors.values = context.read(&self.device.rows)?;
        let mut state = Trainable {
            anchors: self.anchors.clone(),
            first: context.read(&self.row_moments.first)?,
            second: context.read(&self.row_moments.second)?,
        };
        let mut statistics = Statistics { shape: self.shape, values: context.read(&self.statistics)? };
        let settings = Densify {
            threshold: self.schedule.growth_threshold,
            min_views: 0.4 * self.schedule.densify_every as f32,
            min_visits: 0.8 * self.schedule.densify_every as f32,
            coarsest: COARSEST_GROWTH,
            max_anchors: self.schedule.max_anchors,
            extent: self.extent,
        };
        let outcome = densify(&mut state, &mut statistics, &settings, rng);
        tracing::debug!(step, grown = outcome.grown, pruned = outcome.pruned, anchors = state.anchors.len());
        if state.anchors.is_empty() {
            return Err(TrainError::NothingLeft { step });
        }
        let networks = context.read(&self.device.networks)?;
        self.device = DeviceAnchors::upload(&context, &state.anchors, &networks)?;
        self.row_moments = Moments::upload(&context, &state.first, &state.second)?;
        self.gradients = AnchorGradients::new(&context, self.shape, state.anchors.len())?;
        self.statistics = context.upload("growth statistics", &statistics.values)?;
        self.anchors = state.anchors;
        Ok(())
    }
}

impl Learner for AnchorLearner {
    fn forward(
        &mut self,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        _step: &Step,
    ) -> Result<(), TrainError> {
        self.neural.forward(recorder, &self.device, camera, self.schedule.volume_weight)?;
        Ok(())
    }

    fn gaussians(&self) -> &Gaussians {
        self.neural.gaussians()
    }

    fn gaussian_gradients(&mut self) -> Result<GaussianGradients, TrainError> {
        Ok(self.neural.gaussian_gradients()?.clone())
    }

    fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        _camera: &Camera,
        step: &Step,
        void_mark: &Buffer<u32>,
    ) -> Result<(), TrainError> {
        self.neural.backward(recorder, &self.device, &self.gradients)?;
        if self.schedule.gathers_statistics(step.number) {
            self.neural.statistics(recorder, &self.device, &self.statistics, void_mark)?;
        }
        let row_rates = recorder.uniform(&self.row_rates(step.fraction))?;
        let network_rates = recorder.uniform(&self.network_rates(step.fraction))?;
        self.adam.step(
            recorder,
            step.number,
            void_mark,
            &row_rates,
            &self.gradients.rows,
            &self.device.rows,
            &self.row_moments,
        )?;
        self.adam.step(
            recorder,
            step.number,
            void_mark,
            &network_rates,
            &self.gradients.networks,
            &self.device.networks,
            &self.network_moments,
        )?;
        Ok(())
    }

    fn adapts(&self, step: &Step) -> bool {
        self.schedule.densifies(step.number)
    }

    fn adapt(&mut self, step: &Step, rng: &mut Pcg64) -> Result<(), TrainError> {
        self.densify(step.number, rng)
    }

    fn size(&self) -> Result<Size, TrainError> {
        Ok(Size { anchors: self.anchors.len(), gaussians: self.neural.counts()?[1] as usize })
    }

    fn save(&self) -> Result<LearnerState, TrainError> {
        let read = |buffer| self.context.read(buffer);
        let Lattice { voxel, origin: [x, y, z] } = self.anchors.lattice;
        let mut state = LearnerState::default();
        state.put("lattice", vec![voxel, x, y, z]);
        state.put("anchors.cells", self.anchors.cells.as_flattened().to_vec());
        state.put("anchors.masks", self.anchors.masks.clone());
        state.put("anchors.rows", read(&self.device.rows)?);
        state.put("anchors.rows.first", read(&self.row_moments.first)?);
        state.put("anchors.rows.second", read(&self.row_moments.second)?);
        state.put("networks", read(&self.device.networks)?);
        state.put("networks.first", read(&self.network_moments.first)?);
        state.put("networks.second", read(&self.network_moments.second)?);
        state.put("growth", read(&self.statistics)?);
        Ok(state)
    }

    fn finish(mut self: Box<Self>, frames: &[&Frame], cancel: &CancelFlag) -> Result<Scene, TrainError> {
        self.anchors.values = self.context.read(&self.device.rows)?;
        let networks = self.context.read(&self.device.networks)?;
        drop_unused(&self.context, &mut self.neural, &self.device, &mut self.anchors, frames, cancel)?;
        if self.anchors.is_empty() {
            return Err(TrainError::NothingLeft { step: self.schedule.steps });
        }
        Ok(Scene::Anchors(self.anchors.to_scene(self.layout.to_networks(&networks))))
    }
}
