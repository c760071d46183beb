//! Chooses the trainer of a model.

use std::{borrow::Cow, sync::Arc};

use rand_pcg::Pcg64;

use super::super::{
    Result, Schedule,
    anchor_stage::AnchorStage,
    anchor_trainer::AnchorTrainer,
    checkpoint::ModelState,
    model_trainer::ModelTrainer,
    plain::PlainTrainer,
    scene_extent::scene_extent,
    scene_frame::{Points, TrainingSet},
};
use crate::{domain::ModelKind, gpu::Device, init::random_points};

/// Creates the model's trainer, new or from a checkpoint.
pub(super) struct ModelFactory<'a> {
    pub(super) device: &'a Arc<Device>,
    pub(super) set: &'a TrainingSet,
    pub(super) schedule: Schedule,
}

impl ModelFactory<'_> {
    /// The trainer at the start of a run.
    pub(super) fn create(self, rng: &mut Pcg64) -> Result<Box<dyn ModelTrainer>> {
        let Self { device, set, schedule } = self;
        let extent = scene_extent(set);
        let points = match &set.points {
            Some(points) => Cow::Borrowed(points),
            None => {
                let (low, high) = set.init_box.corners();
                let positions = random_points(rng, schedule.random_points, low, high);
                Cow::Owned(Points { positions, colors: Vec::new() })
            }
        };
        let Points { positions, colors } = points.as_ref();
        Ok(match schedule.model {
            ModelKind::Tcgs | ModelKind::Scaffold => {
                if schedule.plain_until > 0 {
                    let first =
                        PlainTrainer::new(device, schedule.plain.clone(), positions, colors, extent, rng)?;
                    Box::new(first.followed_by(AnchorStage::new(schedule, extent)))
                } else {
                    Box::new(AnchorTrainer::new(device, schedule, points.as_ref(), extent, rng)?)
                }
            }
            ModelKind::Gaussians3d => {
                Box::new(PlainTrainer::new(device, schedule.plain, positions, colors, extent, rng)?)
            }
        })
    }

    /// The trainer that a checkpoint holds the state of.
    pub(super) fn resume(self, state: ModelState) -> Result<Box<dyn ModelTrainer>> {
        let Self { device, set, schedule } = self;
        let extent = scene_extent(set);
        Ok(match schedule.model {
            ModelKind::Tcgs | ModelKind::Scaffold
                if schedule.plain_until > 0 && PlainTrainer::saved(&state) =>
            {
                let first = PlainTrainer::resume(device, schedule.plain.clone(), extent, state)?;
                Box::new(first.followed_by(AnchorStage::new(schedule, extent)))
            }
            ModelKind::Tcgs | ModelKind::Scaffold => {
                Box::new(AnchorTrainer::resume(device, schedule, extent, state)?)
            }
            ModelKind::Gaussians3d => Box::new(PlainTrainer::resume(device, schedule.plain, extent, state)?),
        })
    }
}
