//! Compression-aware training in a checkpoint.

use std::sync::Arc;

use super::{Compression, context_model::ContextModel, group_channels};
use crate::{
    domain::{ContextFrame, ContextKind},
    gpu::Device,
    model::AnchorRows,
    train::{
        BaseQuantSteps, CheckpointError, CompressionSchedule, Result,
        checkpoint::ModelState,
        context::{ContextConfig, ContextState, GroupStatistics, PlaneConfig},
    },
};

impl Compression {
    /// Adds everything that the next step depends on.
    pub(in crate::train) fn save(&self, state: &mut ModelState) -> Result<()> {
        let Some(quant) = &self.quant else { return Ok(()) };
        let BaseQuantSteps { feature, scaling, offset } = quant.base_quant_steps;
        state.put("steps.base", vec![feature, scaling, offset]);
        state.put("steps", self.device.read(quant.rows.steps())?);
        let Some(context_model) = &self.context_model else { return Ok(()) };
        if let Some(share) = self.feature_share {
            state.put("features.share", vec![share as f32]);
        }
        let config = &context_model.net.layout().config;
        let PlaneConfig { edge, channels, layers, hidden, latents } = config.planes;
        let sizes =
            [config.kind as usize, edge, channels, layers, hidden, latents].into_iter().chain(config.hidden);
        state.put("context.sizes", sizes.map(|size| size as u32).collect());
        state.put("context.centre", context_model.frame.center.to_vec());
        state.put("context.half", context_model.frame.half.to_vec());
        let statistics = |values: fn(&GroupStatistics) -> &Vec<f32>| {
            context_model.statistics.iter().flat_map(|group| values(group).clone()).collect::<Vec<f32>>()
        };
        state.put("context.means", statistics(|group| &group.means));
        state.put("context.deviations", statistics(|group| &group.deviations));
        let ContextState { values, first, second } = context_model.net.save()?;
        state.put("context", values);
        state.put("context.first", first);
        state.put("context.second", second);
        Ok(())
    }

    /// The compression that [`Self::save`] saved, for its anchors.
    pub(in crate::train) fn resume(
        device: &Arc<Device>,
        schedule: CompressionSchedule,
        anchors: &AnchorRows,
        state: &mut ModelState,
    ) -> Result<Self> {
        let mut resumed = Self::new(device, schedule, anchors.shape);
        if !state.has("steps") {
            return Ok(resumed);
        }
        let positive = |name: &str, values: &[f32]| {
            if values.iter().all(|value| value.is_finite() && *value > 0.0) {
                return Ok(());
            }
            Err(CheckpointError::array(name, "has a step that is not positive"))
        };
        let base: Vec<f32> = state.take_exactly("steps.base", 3)?;
        positive("steps.base", &base)?;
        let steps = BaseQuantSteps { feature: base[0], scaling: base[1], offset: base[2] };
        let of_anchors: Vec<f32> = state.take_exactly("steps", 3 * anchors.len())?;
        positive("steps", &of_anchors)?;
        resumed.quantize(steps, steps.in_world(anchors.lattice.voxel), &of_anchors)?;
        if state.has("features.share") {
            let share = state.take_exactly::<f32>("features.share", 1)?[0];
            if !(0.0..=1.0).contains(&share) {
                return Err(CheckpointError::array("features.share", "is not a share").into());
            }
            resumed.feature_share = Some(share.into());
        }
        if state.has("context") {
            resumed.context_model = Some(resumed.resume_model(anchors, state)?);
        }
        Ok(resumed)
    }

    fn resume_model(&self, anchors: &AnchorRows, state: &mut ModelState) -> Result<ContextModel> {
        let sizes: Vec<u32> = state.take_exactly("context.sizes", 9)?;
        let size = |index: usize| sizes[index] as usize;
        let channels = group_channels(self.layout.shape);
        let kinds = [ContextKind::Position, ContextKind::TriPlane, ContextKind::TriPlaneKnn];
        let Some(kind) = kinds.into_iter().find(|kind| *kind as u32 == sizes[0]) else {
            return Err(CheckpointError::array("context.sizes", "are no model's").into());
        };
        let config = ContextConfig {
            kind,
            channels,
            hidden: [size(6), size(7), size(8)],
            planes: PlaneConfig {
                edge: size(1),
                channels: size(2),
                layers: size(3),
                hidden: size(4),
                latents: size(5),
            },
        };
        // Larger sizes would allocate more than the memory estimate.
        if config.planes.edge > 256 || sizes.iter().any(|size| *size > 1024) {
            return Err(CheckpointError::array("context.sizes", "are no model's").into());
        }
        let center: Vec<i32> = state.take_exactly("context.centre", 3)?;
        let half: Vec<u32> = state.take_exactly("context.half", 3)?;
        let frame =
            ContextFrame { center: [center[0], center[1], center[2]], half: [half[0], half[1], half[2]] };
        let all: usize = channels.iter().sum();
        let mut split = |name: &str| -> Result<[Vec<f32>; 3], CheckpointError> {
            let mut rest: Vec<f32> = state.take_exactly(name, all)?;
            let offsets = rest.split_off(channels[0] + channels[1]);
            let scalings = rest.split_off(channels[0]);
            Ok([rest, scalings, offsets])
        };
        let (means, deviations) = (split("context.means")?, split("context.deviations")?);
        let mut groups = means.into_iter().zip(deviations);
        let statistics = std::array::from_fn(|_| {
            let (means, deviations) = groups.next().unwrap_or_default();
            GroupStatistics { means, deviations }
        });
        let model = ContextState {
            values: state.take("context")?,
            first: state.take("context.first")?,
            second: state.take("context.second")?,
        };
        self.context_model_of(config, &model, frame, statistics, &anchors.cells)
    }
}
