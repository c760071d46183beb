//! The second stage of an anchor model that begins as plain Gaussians: they move to the surfaces and grow there, and then become anchors.
//!
//! Invariants: the steps of both stages are the run's; the second stage's optimizer and statistics begin anew.

use std::sync::Arc;

use rand_pcg::Pcg64;

use super::{Result, Schedule, anchor_trainer::AnchorTrainer, model_trainer::Step};
use crate::{gpu::Device, init::anchors_from_gaussians, model::GaussianRows};

/// How plain Gaussians become anchors, and when.
pub(super) struct AnchorStage {
    schedule: Schedule,
    extent: f32,
}

impl AnchorStage {
    /// The stage of a schedule that begins with plain Gaussians; `extent` is the scene's, in world units.
    pub(super) fn new(schedule: Schedule, extent: f32) -> Self {
        Self { schedule, extent }
    }

    /// Whether it begins after a step.
    pub(super) fn begins_after(&self, step: &Step) -> bool {
        step.number >= self.schedule.plain_until
    }

    /// A trainer of anchors in place of the Gaussians.
    pub(super) fn begin(
        &self,
        device: &Arc<Device>,
        gaussians: &GaussianRows,
        step: &Step,
        rng: &mut Pcg64,
    ) -> Result<AnchorTrainer> {
        let Schedule { voxel, coarsest_growth, shape, max_anchors, passing_units, .. } = self.schedule;
        // Half as large again as what growth puts one anchor into.
        let cell = i32::from(coarsest_growth) * 3 / 2;
        // Half the limit is left for growth.
        let first = anchors_from_gaussians(
            gaussians,
            |means| voxel.for_points(means, self.extent),
            cell,
            shape,
            max_anchors / 2,
            passing_units,
            rng,
        )?;
        tracing::debug!(
            step = step.number,
            gaussians = gaussians.len(),
            anchors = first.anchors.len(),
            "Gaussians become anchors"
        );
        AnchorTrainer::begin(device, self.schedule.clone(), first, self.extent)
    }
}
