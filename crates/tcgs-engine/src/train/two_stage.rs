//! An anchor model that begins as plain Gaussians: they move to the surfaces and grow there, and then become anchors.
//!
//! Invariants: the steps of both stages are the run's; the second stage's optimizer and statistics begin anew.

use std::sync::Arc;

use rand_pcg::Pcg64;

use super::{
    Result, Schedule,
    anchor_trainer::AnchorTrainer,
    checkpoint::ModelState,
    model_trainer::{BitrateSample, FigureBuffers, FinishedModel, ModelSize, ModelTrainer, Step, Views},
    plain::PlainTrainer,
};
use crate::{
    domain::Camera,
    gpu::{Buffer, Device, Recorder},
    init::anchors_from_gaussians,
    render::{GaussianGradients, Gaussians},
};

/// See the module's documentation.
pub(super) struct TwoStageTrainer {
    device: Arc<Device>,
    schedule: Schedule,
    extent: f32,
    stage: CurrentTrainer,
}

enum CurrentTrainer {
    Gaussians(Box<PlainTrainer>),
    Anchors(Box<AnchorTrainer>),
}

impl CurrentTrainer {
    fn trainer(&self) -> &dyn ModelTrainer {
        match self {
            CurrentTrainer::Gaussians(trainer) => trainer.as_ref(),
            CurrentTrainer::Anchors(trainer) => trainer.as_ref(),
        }
    }

    fn trainer_mut(&mut self) -> &mut dyn ModelTrainer {
        match self {
            CurrentTrainer::Gaussians(trainer) => trainer.as_mut(),
            CurrentTrainer::Anchors(trainer) => trainer.as_mut(),
        }
    }
}

impl TwoStageTrainer {
    /// A trainer whose first stage is `first`; `extent` is the scene's, in world units.
    pub(super) fn new(device: &Arc<Device>, schedule: Schedule, first: PlainTrainer, extent: f32) -> Self {
        let stage = CurrentTrainer::Gaussians(Box::new(first));
        Self { device: Arc::clone(device), schedule, extent, stage }
    }

    /// The trainer with the state that [`ModelTrainer::save`] returned.
    pub(super) fn resume(
        device: &Arc<Device>,
        schedule: Schedule,
        extent: f32,
        state: ModelState,
    ) -> Result<Self> {
        let stage = if PlainTrainer::saved(&state) {
            CurrentTrainer::Gaussians(Box::new(PlainTrainer::resume(
                device,
                schedule.plain.clone(),
                extent,
                state,
            )?))
        } else {
            CurrentTrainer::Anchors(Box::new(AnchorTrainer::resume(device, schedule.clone(), extent, state)?))
        };
        Ok(Self { device: Arc::clone(device), schedule, extent, stage })
    }

    /// Replaces the Gaussians by anchors.
    fn make_anchors(&mut self, step: u32, rng: &mut Pcg64) -> Result<()> {
        let CurrentTrainer::Gaussians(trainer) = &self.stage else { return Ok(()) };
        let rows = trainer.rows()?;
        let Schedule { voxel, coarsest_growth, shape, max_anchors, passing_units, .. } = self.schedule;
        // Half as large again as what growth puts one anchor into.
        let cell = i32::from(coarsest_growth) * 3 / 2;
        // Half the limit is left for growth.
        let first = anchors_from_gaussians(
            &rows,
            |means| voxel.for_points(means, self.extent),
            cell,
            shape,
            max_anchors / 2,
            passing_units,
            rng,
        )?;
        tracing::debug!(
            step,
            gaussians = rows.len(),
            anchors = first.anchors.len(),
            "Gaussians become anchors"
        );
        let schedule = self.schedule.clone();
        let anchors = AnchorTrainer::begin(&self.device, schedule, first, self.extent)?;
        self.stage = CurrentTrainer::Anchors(Box::new(anchors));
        Ok(())
    }

    fn ends_first_stage(&self, step: &Step) -> bool {
        matches!(self.stage, CurrentTrainer::Gaussians(_)) && step.number >= self.schedule.plain_until
    }
}

impl ModelTrainer for TwoStageTrainer {
    fn forward(&mut self, recorder: &mut Recorder<'_>, camera: &Camera, step: &Step) -> Result<()> {
        self.stage.trainer_mut().forward(recorder, camera, step)
    }

    fn gaussians(&self) -> &Gaussians {
        self.stage.trainer().gaussians()
    }

    fn gaussian_gradients(&mut self) -> Result<GaussianGradients> {
        self.stage.trainer_mut().gaussian_gradients()
    }

    fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        step: &Step,
        overflow_flag: &Buffer<u32>,
    ) -> Result<()> {
        self.stage.trainer_mut().backward(recorder, step, overflow_flag)
    }

    fn reschedule(&mut self, schedule: &Schedule) {
        let max_anchors = self.schedule.max_anchors;
        self.schedule = Schedule { max_anchors, ..schedule.clone() };
        self.stage.trainer_mut().reschedule(schedule);
    }

    fn adapts(&self, step: &Step) -> bool {
        self.ends_first_stage(step) || self.stage.trainer().adapts(step)
    }

    fn adapt(&mut self, step: &Step, rng: &mut Pcg64, views: &mut Views<'_>) -> Result<()> {
        if self.ends_first_stage(step) {
            self.make_anchors(step.number, rng)?;
        }
        self.stage.trainer_mut().adapt(step, rng, views)
    }

    fn anchors(&self) -> usize {
        self.stage.trainer().anchors()
    }

    fn figures(&self) -> FigureBuffers {
        self.stage.trainer().figures()
    }

    fn size(&self, counts: Option<&[u32]>) -> ModelSize {
        self.stage.trainer().size(counts)
    }

    fn bitrate(&self, step: u32, bits: &[f32]) -> Result<Option<BitrateSample>> {
        self.stage.trainer().bitrate(step, bits)
    }

    fn save(&self) -> Result<ModelState> {
        self.stage.trainer().save()
    }

    fn finish(self: Box<Self>, views: &mut Views<'_>) -> Result<FinishedModel> {
        match self.stage {
            CurrentTrainer::Gaussians(trainer) => trainer.finish(views),
            CurrentTrainer::Anchors(trainer) => trainer.finish(views),
        }
    }
}
