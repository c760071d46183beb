//! The anchor model in training: features, scalings and offsets of anchors, and the networks that they share.

use std::sync::Arc;

use rand_pcg::Pcg64;

use super::{
    Adam, Decay, Densify, Moments, Schedule, Statistics, TrainError,
    densify::{Trainable, densify},
    learner::{Learner, Size, Step},
    unused::drop_unused,
};
use crate::{
    domain::{Camera, CancelFlag, Frame, Scene},
    gpu::{Buffer, Context, Recorder},
    model::{AnchorRows, NetworkLayout, Shape, initial_rows},
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

impl AnchorLearner {
    /// Anchors at `points` and fresh networks; `extent` is the scene's, in world units.
    pub(super) fn begin(
        context: &Arc<Context>,
        mut schedule: Schedule,
        points: &[[f32; 3]],
        extent: f32,
        rng: &mut Pcg64,
    ) -> Result<Self, TrainError> {
        let shape = schedule.shape;
        schedule.max_anchors = schedule.max_anchors.min(NeuralGaussians::most_anchors(context, shape));
        let rule = schedule.voxel.for_points(points, extent);
        // Growth needs room above what the points begin with.
        let anchors = initial_rows(points, rule, shape, schedule.max_anchors / 2)?;
        let layout = NetworkLayout::new(shape);
        let networks = layout.initial(rng);
        Ok(Self {
            schedule,
            shape,
            extent,
            owners: layout.owners(),
            device: DeviceAnchors::upload(context, &anchors, &networks)?,
            gradients: AnchorGradients::new(context, shape, anchors.len())?,
            row_moments: Moments::zero(context, anchors.values.len())?,
            network_moments: Moments::zero(context, layout.parameters)?,
            statistics: context.buffer("growth statistics", anchors.len() * Statistics::width(shape))?,
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
    ) -> Result<(), TrainError> {
        self.neural.backward(recorder, &self.device, &self.gradients)?;
        if self.schedule.gathers_statistics(step.number) {
            self.neural.statistics(recorder, &self.device, &self.statistics)?;
        }
        let row_rates = recorder.uniform(&self.row_rates(step.fraction))?;
        let network_rates = recorder.uniform(&self.network_rates(step.fraction))?;
        self.adam.step(
            recorder,
            step.number,
            &row_rates,
            &self.gradients.rows,
            &self.device.rows,
            &self.row_moments,
        )?;
        self.adam.step(
            recorder,
            step.number,
            &network_rates,
            &self.gradients.networks,
            &self.device.networks,
            &self.network_moments,
        )?;
        Ok(())
    }

    fn adapt(&mut self, step: &Step, rng: &mut Pcg64) -> Result<(), TrainError> {
        if self.schedule.densifies(step.number) {
            self.densify(step.number, rng)?;
        }
        Ok(())
    }

    fn size(&self) -> Result<Size, TrainError> {
        Ok(Size { anchors: self.anchors.len(), gaussians: self.neural.counts()?[1] as usize })
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
