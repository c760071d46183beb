//! Fits context models to a finished scene, to measure what their inputs save.
//!
//! Invariant: each group has one quantization step for all anchors, which no model adjusts, so an encoder codes the same symbols with
//! every model.

use std::sync::Arc;

use super::{Compression, context_fit::stored_contexts};
use crate::{
    domain::{AnchorScene, CancelFlag, ContextCandidates, ContextKind, TrainOptions},
    gpu::Device,
    model::{AnchorRows, ModelShape, NetworkLayout},
    render::DeviceAnchors,
    train::{
        Adam, BaseQuantSteps, CompressionSchedule, Result, Schedule,
        context::{ContextConfig, ContextLayout},
    },
};

/// How models are fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ContextFitSettings {
    /// Optimizer steps of each model.
    pub steps: u32,
    /// Seed of initial values and samples.
    pub seed: u64,
}

/// Fits a model of each of `configs` to the attributes of `scene` by their bits alone, at the quantization steps `steps` of the
/// three groups. Each of the results has one model, for [`crate::codec::encode`] with the same steps.
///
/// # Errors
/// [`crate::train::TrainError::Context`] if a configuration is not known to the kernels; cancellation between two steps; errors of the
/// device.
pub fn fit_contexts(
    device: &Arc<Device>,
    scene: &AnchorScene,
    steps: BaseQuantSteps,
    configs: &[ContextConfig],
    settings: ContextFitSettings,
    cancel: &CancelFlag,
) -> Result<Vec<ContextCandidates>> {
    let options = TrainOptions { seed: settings.seed, ..TrainOptions::default() };
    let Some(schedule) = CompressionSchedule::new(&options, Schedule::new(&options).steps) else {
        return Ok(Vec::new());
    };
    // The run's own model is not fitted, so it need not find neighbors.
    let schedule = CompressionSchedule { kind: ContextKind::Position, ..schedule };
    let rows = AnchorRows::from_scene(scene);
    let networks = NetworkLayout::new(ModelShape::of(scene))
        .from_networks(&scene.networks)
        .map_err(crate::render::RenderError::Scene)?;
    let anchors = DeviceAnchors::upload(device, &rows, &networks)?;
    let base = steps.in_world(scene.lattice.voxel);
    let mut compression = Compression::new(device, schedule, rows.shape);
    compression.quantize(steps, base, &base.repeat(rows.len()))?;
    compression.model(&rows)?;
    let adam = Adam::new(device)?;
    let Some(fit) = compression.context_fit(&adam, &anchors, &rows, settings.steps, cancel)? else {
        return Ok(Vec::new());
    };
    let Some(model) = &compression.context_model else { return Ok(Vec::new()) };
    configs
        .iter()
        .map(|config| {
            let net = fit.fitted(*config)?;
            let mut values = net.save()?.values;
            keep_steps(net.layout(), &mut values);
            let (position, planes) = stored_contexts(net.layout(), &values);
            let planes = planes.into_iter().collect();
            Ok(ContextCandidates { frame: model.frame, static_steps: [0.0; 3], position, planes })
        })
        .collect()
}

/// Makes networks adjust no step. A group's adjustment is its last output; after the rows of weights is that of biases.
fn keep_steps(layout: &ContextLayout, values: &mut [f32]) {
    for head in &layout.heads {
        for row in 0..=head.inputs {
            values[head.weights + row * head.outputs + head.outputs - 1] = 0.0;
        }
    }
}
