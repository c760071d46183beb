//! Plain Gaussians in training: the published baseline of 3D Gaussian splatting, with the losses, the rasterizer and the
//! optimizer of the other models.

mod grow;
mod prune;

use std::sync::Arc;

use rand_pcg::Pcg64;

use super::{
    Adam, AdamStep, CheckpointError, Moments, Result, TrainError,
    anchor_stage::AnchorStage,
    checkpoint::ModelState,
    model_trainer::{BitrateSample, FigureBuffers, FinishedModel, ModelSize, ModelTrainer, Step, Views},
    schedule::PlainSchedule,
};
use crate::{
    domain::{Camera, GaussianScene, NearPlane, Scene},
    gpu::{Buffer, Device, Recorder},
    init::initial_gaussians,
    model::{
        GaussianRows,
        gaussian_rows::{BANDS, BASE, COLOR, LOG_SCALE, OPACITY, QUAT, band_values},
    },
    render::{DeviceGaussians, GaussianGradients, Gaussians, PlainGaussians, STATISTICS},
};
use grow::{GrowthSettings, TrainableGaussians, grow_and_prune, reset_opacities};

/// Names of the arrays of a checkpoint: parameters, first and second moments.
const ROWS: [&str; 3] = ["gaussians", "gaussians.first", "gaussians.second"];

/// Name of the array with the spherical harmonics of degree `band` + 1.
fn band_name(rows: &str, band: usize) -> String {
    format!("{rows}.band{}", band + 1)
}

/// Gaussians with the state of their optimizer and of growth.
pub(super) struct PlainTrainer {
    device: Arc<Device>,
    schedule: PlainSchedule,
    extent: f32,
    rows: DeviceGaussians,
    gradients: DeviceGaussians,
    first: DeviceGaussians,
    second: DeviceGaussians,
    statistics: Buffer<f32>,
    plain: PlainGaussians,
    adam: Adam,
    /// Where the Gaussians are the first stage of an anchor model.
    next: Option<AnchorStage>,
}

impl PlainTrainer {
    /// A trainer with Gaussians at `points`, whose `colors` may be empty; `extent` is the scene's, in world units.
    pub(super) fn new(
        device: &Arc<Device>,
        mut schedule: PlainSchedule,
        points: &[[f32; 3]],
        colors: &[[u8; 3]],
        extent: f32,
        rng: &mut Pcg64,
    ) -> Result<Self> {
        schedule.max_gaussians = schedule.max_gaussians.min(PlainGaussians::max_gaussians(device.adapter()));
        // Half the limit is left for growth.
        let values = initial_gaussians(points, colors, schedule.max_gaussians / 2, rng)?;
        let zero = || DeviceGaussians::plan(values.len()).make(device);
        Ok(Self {
            schedule,
            extent,
            rows: DeviceGaussians::upload(device, &values)?,
            gradients: zero()?,
            first: zero()?,
            second: zero()?,
            statistics: device.buffer("growth statistics", STATISTICS * values.len())?,
            plain: PlainGaussians::new(Arc::clone(device), NearPlane::of_extent(extent).depth())?,
            adam: Adam::new(device)?,
            device: Arc::clone(device),
            next: None,
        })
    }

    /// The same as the first stage of an anchor model.
    pub(super) fn followed_by(self, next: AnchorStage) -> Self {
        Self { next: Some(next), ..self }
    }

    /// The trainer with the state that [`ModelTrainer::save`] returned.
    pub(super) fn resume(
        device: &Arc<Device>,
        schedule: PlainSchedule,
        extent: f32,
        mut state: ModelState,
    ) -> Result<Self> {
        let mut rows = Vec::new();
        for name in ROWS {
            let base: Vec<f32> = state.take(name)?;
            let count = base.len() / BASE;
            if count == 0 || base.len() != count * BASE {
                let error = format!("has {} values, which is not a multiple of {BASE}", base.len());
                return Err(CheckpointError::array(name, error).into());
            }
            let mut band = |band: usize| state.take_exactly(&band_name(name, band), count * BANDS[band]);
            rows.push(GaussianRows { base, bands: [band(0)?, band(1)?, band(2)?] });
        }
        let count = rows[0].len();
        if let Some(name) = ROWS.iter().zip(&rows).find(|(_, rows)| rows.len() != count).map(|(name, _)| name)
        {
            return Err(CheckpointError::array(name, format!("is not of {count} Gaussians")).into());
        }
        let statistics = state.take_exactly::<f32>("growth", STATISTICS * count)?;
        let degree = state.take_exactly::<u32>("degree", 1)?[0];
        state.finish()?;
        if degree as usize > BANDS.len() {
            return Err(CheckpointError::array("degree", format!("is {degree}")).into());
        }
        let mut plain = PlainGaussians::new(Arc::clone(device), NearPlane::of_extent(extent).depth())?;
        plain.set_degree(degree)?;
        Ok(Self {
            schedule,
            extent,
            rows: DeviceGaussians::upload(device, &rows[0])?,
            gradients: DeviceGaussians::plan(count).make(device)?,
            first: DeviceGaussians::upload(device, &rows[1])?,
            second: DeviceGaussians::upload(device, &rows[2])?,
            statistics: device.upload("growth statistics", &statistics)?,
            plain,
            adam: Adam::new(device)?,
            device: Arc::clone(device),
            next: None,
        })
    }

    /// Whether a state is of plain Gaussians.
    pub(super) fn saved(state: &ModelState) -> bool {
        state.has(ROWS[0])
    }

    fn base_learning_rates(&self, fraction: f64) -> [f32; BASE] {
        let mut rates = [self.schedule.color; BASE];
        rates[..LOG_SCALE].fill(self.schedule.mean.at(fraction) as f32 * self.extent);
        rates[LOG_SCALE..QUAT].fill(self.schedule.log_scale);
        rates[QUAT..OPACITY].fill(self.schedule.quat);
        rates[OPACITY..COLOR].fill(self.schedule.opacity);
        rates
    }

    /// Records the optimizer's step on the base values and on the bands in use.
    fn learn(&self, recorder: &mut Recorder<'_>, step: &Step, overflow_flag: &Buffer<u32>) -> Result<()> {
        let learning_rates = recorder.uniform(&self.base_learning_rates(step.fraction))?;
        let adam_step = AdamStep { number: step.number, overflow_flag };
        let moments = Moments { first: self.first.base.clone(), second: self.second.base.clone() };
        let (gradients, rows) = (&self.gradients, &self.rows);
        self.adam.step(recorder, adam_step, &learning_rates, &gradients.base, &rows.base, &moments)?;
        let in_use = self.rows.count * band_values(self.plain.degree() as usize);
        if in_use > 0 {
            let learning_rates = recorder.uniform(&[self.schedule.coefficients])?;
            let moments = Moments { first: self.first.bands.clone(), second: self.second.bands.clone() };
            let bands = rows.bands.first(in_use);
            self.adam.step(recorder, adam_step, &learning_rates, &gradients.bands, &bands, &moments)?;
        }
        Ok(())
    }

    fn download(&self) -> Result<TrainableGaussians> {
        Ok(TrainableGaussians {
            values: self.rows.download(&self.device)?,
            first: self.first.download(&self.device)?,
            second: self.second.download(&self.device)?,
        })
    }

    fn upload(&mut self, state: &TrainableGaussians) -> Result<()> {
        let count = state.values.len();
        self.rows = DeviceGaussians::upload(&self.device, &state.values)?;
        self.first = DeviceGaussians::upload(&self.device, &state.first)?;
        self.second = DeviceGaussians::upload(&self.device, &state.second)?;
        if count != self.gradients.count {
            self.gradients = DeviceGaussians::plan(count).make(&self.device)?;
        }
        Ok(())
    }

    fn grow(&mut self, state: &mut TrainableGaussians, step: u32, rng: &mut Pcg64) -> Result<()> {
        let statistics = self.device.read(&self.statistics)?;
        let settings = GrowthSettings {
            threshold: self.schedule.growth_threshold,
            extent: self.extent,
            max_gaussians: self.schedule.max_gaussians,
            prune_large: self.schedule.prunes_large(step),
        };
        let outcome = grow_and_prune(state, &statistics, &settings, rng);
        let gaussians = state.values.len();
        tracing::debug!(step, outcome.cloned, outcome.split, outcome.pruned, gaussians);
        if gaussians == 0 {
            return Err(TrainError::NothingLeft { step });
        }
        // All statistics restart, also of Gaussians that did not grow, as published.
        self.statistics = self.device.buffer("growth statistics", STATISTICS * gaussians)?;
        Ok(())
    }
}

impl ModelTrainer for PlainTrainer {
    fn forward(&mut self, recorder: &mut Recorder<'_>, camera: &Camera, step: &Step) -> Result<()> {
        self.plain.set_degree(self.schedule.degree(step.number))?;
        self.plain.forward(recorder, &self.rows, camera)?;
        Ok(())
    }

    fn gaussians(&self) -> &Gaussians {
        self.plain.gaussians()
    }

    fn gaussian_gradients(&mut self) -> Result<GaussianGradients> {
        Ok(self.plain.gaussian_gradients()?.clone())
    }

    fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        step: &Step,
        overflow_flag: &Buffer<u32>,
    ) -> Result<()> {
        self.plain.backward(recorder, &self.rows, &self.gradients)?;
        if self.schedule.gathers_statistics(step.number) {
            self.plain.statistics(recorder, &self.statistics, overflow_flag)?;
        }
        recorder.stage("optimizer");
        self.learn(recorder, step, overflow_flag)
    }

    fn count_views_with_gradient(&mut self) -> Result<()> {
        Ok(self.plain.count_views_with_gradient()?)
    }

    fn adapts(&self, step: &Step) -> bool {
        self.next.as_ref().is_some_and(|next| next.begins_after(step))
            || self.prunes_after(step.number)
            || self.schedule.densifies(step.number)
            || self.schedule.resets(step.number)
    }

    fn successor(&self, step: &Step, rng: &mut Pcg64) -> Result<Option<Box<dyn ModelTrainer>>> {
        let Some(next) = self.next.as_ref().filter(|next| next.begins_after(step)) else { return Ok(None) };
        let gaussians = self.rows.download(&self.device)?;
        Ok(Some(Box::new(next.begin(&self.device, &gaussians, step, rng)?)))
    }

    fn adapt(&mut self, step: &Step, rng: &mut Pcg64, views: &mut Views<'_>) -> Result<()> {
        let (grows, resets) = (self.schedule.densifies(step.number), self.schedule.resets(step.number));
        if grows || resets {
            let mut state = self.download()?;
            if grows {
                self.grow(&mut state, step.number, rng)?;
            }
            if resets {
                reset_opacities(&mut state);
            }
            self.upload(&state)?;
        }
        self.prune_after(step, views)
    }

    fn anchors(&self) -> usize {
        0
    }

    fn figures(&self) -> FigureBuffers {
        FigureBuffers::default()
    }

    fn size(&self, _counts: Option<&[u32]>) -> ModelSize {
        ModelSize { anchors: 0, gaussians: Some(self.rows.count) }
    }

    fn bitrate(&self, _step: u32, _bits: &[f32]) -> Result<Option<BitrateSample>> {
        Ok(None)
    }

    fn save(&self) -> Result<ModelState> {
        let TrainableGaussians { values, first, second } = self.download()?;
        let mut state = ModelState::default();
        for (name, rows) in ROWS.into_iter().zip([values, first, second]) {
            state.put(name, rows.base);
            for (band, values) in rows.bands.into_iter().enumerate() {
                state.put(&band_name(name, band), values);
            }
        }
        state.put("growth", self.device.read(&self.statistics)?);
        // The degree of the last view, which a run resumed after its last step does not render again.
        state.put("degree", vec![self.plain.degree()]);
        Ok(state)
    }

    fn finish(self: Box<Self>, _views: &mut Views<'_>) -> Result<FinishedModel> {
        let rows = self.rows.download(&self.device)?;
        let scene = rows.to_scene(self.plain.degree() as usize);
        let scene = Scene::Gaussians(GaussianScene { near: NearPlane::of_extent(self.extent), ..scene });
        Ok(FinishedModel { scene, unrounded: None, context: None })
    }
}
