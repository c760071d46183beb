//! The quantization and the context model of a scene in training.

use crate::{
    domain::ContextFrame,
    train::{
        BaseQuantSteps,
        context::{
            AnchorSample, ContextLayout, ContextNet, ContextPass, GroupStatistics, PlaneSource,
            QuantizedRows, RateTerm, RoundedNetworks, SampleOutputs,
        },
    },
};

/// Largest integers of the weights that the last stage trains on: 8 bits.
const LEVELS: u8 = 127;

/// The quantized rows and networks, from the first noise on.
#[derive(Debug)]
pub(super) struct QuantState {
    pub(super) base_quant_steps: BaseQuantSteps,
    /// The same with scalings in world units.
    pub(super) base: [f32; 3],
    pub(super) rows: QuantizedRows,
    pub(super) networks: RoundedNetworks,
}

/// The context model, its rate term and what they are made from, once they learn.
#[derive(Debug)]
pub(super) struct ContextModel {
    pub(super) frame: ContextFrame,
    pub(super) statistics: [GroupStatistics; 3],
    pub(super) net: ContextNet,
    pub(super) rate: RateTerm,
    /// Anchors of the last sample.
    pub(super) sampled: usize,
    /// Whether a part of the networks is new and has to be fitted before it is judged.
    pub(super) renewed: bool,
}

/// Approximate bytes of an entropy-coded weight or latent of a context model: encoders choose 4 to 6 bits for most.
pub(super) const BYTES_PER_PARAMETER: f64 = 0.5;

/// Initializes the step adjustments that a model predicts with `octaves`. The selected model gives the anchors their
/// quantization steps from then on; one that still had to learn them would undo what the steps have learnt.
pub(super) fn set_initial_adjustments(layout: &ContextLayout, octaves: [f32; 3], values: &mut [f32]) {
    for (head, octaves) in layout.heads.iter().zip(octaves) {
        // The last output of a group is its step adjustment.
        values[head.bias + head.outputs - 1] = octaves;
    }
}

/// The context model as a file stores it.
pub(super) fn stored_pass(planes_learn: bool) -> ContextPass {
    ContextPass { source: PlaneSource::Latents, reconstruction: 0.0, levels: Some(LEVELS), planes_learn }
}

/// Weights and latents of a model that a file stores.
pub(super) fn stored_parameters(layout: &ContextLayout) -> usize {
    layout.networks + layout.latents.len() + layout.up.iter().map(|up| up.weight_count()).sum::<usize>()
}

/// The anchors of a model's last recorded forward pass.
pub(super) fn sample_of(net: &ContextNet, count: usize) -> AnchorSample<'_> {
    AnchorSample { list: net.sample(), count, capacity: net.columns() }
}

/// The outputs of a model's last recorded forward pass.
pub(super) fn outputs_of(net: &ContextNet) -> SampleOutputs<'_> {
    let [features, scalings, offsets, _] = net.layout().config.output_rows();
    SampleOutputs {
        values: net.outputs(),
        gradients: net.output_gradients(),
        first_rows: [features, scalings, offsets],
    }
}
