//! The distribution of each symbol: the interface between attribute coding and the model of the attributes.
//!
//! Encoder and decoder query the same model in the same order. A model uses what is decoded before the attributes (manifest, cells,
//! networks, planes) and nothing else.

use super::{
    anchors::AnchorContext,
    dense::{Activations, IntegerMlp, padded},
    quant_steps,
};
use crate::{codec::symbols::Distribution, domain::context_model::ContextKind};

/// The model of an attribute group.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::codec) enum GroupModel {
    /// One distribution a channel, the same for every anchor.
    Static {
        /// Step index of every anchor.
        step_index: i8,
        /// Of each channel.
        channels: Vec<Distribution>,
    },
    /// A network's predictions.
    Network(ContextNetwork),
}

/// A network and its kind of inputs.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::codec) struct ContextNetwork {
    /// Its inputs.
    pub(in crate::codec) kind: ContextKind,
    /// Its layers.
    pub(in crate::codec) mlp: IntegerMlp,
}

impl GroupModel {
    /// Prepares predictions for anchors; `anchors` must have the inputs of the network.
    pub(in crate::codec) fn predictions<'a>(&'a self, anchors: &'a AnchorContext) -> Predictions<'a> {
        let distributions = match self {
            GroupModel::Static { channels, .. } => channels.clone(),
            GroupModel::Network(_) => Vec::new(),
        };
        Predictions {
            model: self,
            anchors,
            activations: Activations::default(),
            outputs: Vec::new(),
            distributions,
        }
    }
}

/// Predictions for one anchor after another.
pub(in crate::codec) struct Predictions<'a> {
    model: &'a GroupModel,
    anchors: &'a AnchorContext,
    activations: Activations,
    outputs: Vec<i32>,
    distributions: Vec<Distribution>,
}

impl Predictions<'_> {
    /// The step index of an anchor (by its place in the file), and the distribution of each channel.
    pub(in crate::codec) fn at(&mut self, anchor: usize) -> (i8, &[Distribution]) {
        let network = match self.model {
            GroupModel::Static { step_index, .. } => return (*step_index, &self.distributions),
            GroupModel::Network(network) => network,
        };
        let input = &mut self.activations.input;
        self.anchors.inputs(network.kind, anchor, input);
        input.resize(padded(input.len()), 0);
        network.mlp.outputs(&mut self.activations, &mut self.outputs);
        let channels = self.outputs.len() / 2;
        let (means, rest) = self.outputs.split_at(channels);
        let step_index = quant_steps::index(rest[channels]);
        self.distributions.clear();
        self.distributions.extend(means.iter().zip(rest).map(|(mean, deviation)| {
            Distribution::Gaussian(quant_steps::gaussian(*mean, *deviation, step_index))
        }));
        (step_index, &self.distributions)
    }
}
