//! The distribution of each symbol: the interface between attribute coding and the model of the attributes.
//!
//! Encoder and decoder query the same model in the same order. A model uses what is decoded before the symbol (manifest, cells,
//! networks, planes, earlier channels of the anchor) and nothing else.

use super::{
    anchors::AnchorContext,
    dense::{Activations, IntegerMlp, padded},
    quant_steps,
    regression::{GroupRegression, residual},
};
use crate::{domain::context_model::ContextKind, symbols::Distribution};

/// The model of an attribute group.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct GroupModel {
    /// What is expected of an anchor before its first symbol.
    pub(crate) base: BaseModel,
    /// What each symbol says of the next ones.
    pub(crate) regression: Option<GroupRegression>,
}

/// What is expected of an anchor from its place.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum BaseModel {
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
pub(crate) struct ContextNetwork {
    /// Its inputs.
    pub(crate) kind: ContextKind,
    /// Its layers.
    pub(crate) mlp: IntegerMlp,
}

impl From<BaseModel> for GroupModel {
    fn from(base: BaseModel) -> Self {
        Self { base, regression: None }
    }
}

impl GroupModel {
    /// Prepares predictions for anchors; `anchors` must have the inputs of the network.
    pub(crate) fn predictions<'a>(&'a self, anchors: &'a AnchorContext) -> Predictions<'a> {
        let distributions = match &self.base {
            BaseModel::Static { channels, .. } => channels.clone(),
            BaseModel::Network(_) => Vec::new(),
        };
        Predictions {
            model: self,
            anchors,
            activations: Activations::default(),
            outputs: Vec::new(),
            distributions,
            residuals: Vec::new(),
        }
    }
}

/// Predictions for one anchor after another, and for each of them one channel after another.
pub(crate) struct Predictions<'a> {
    model: &'a GroupModel,
    anchors: &'a AnchorContext,
    activations: Activations,
    outputs: Vec<i32>,
    /// The base model's, for the current anchor.
    distributions: Vec<Distribution>,
    /// Of the channels that were observed: symbol less the base model's mean, in sixteenths of a step.
    residuals: Vec<i64>,
}

impl Predictions<'_> {
    /// Begins with an anchor, by its place in the file; returns its step index.
    pub(crate) fn begin(&mut self, anchor: usize) -> i8 {
        self.residuals.clear();
        let network = match &self.model.base {
            BaseModel::Static { step_index, .. } => return *step_index,
            BaseModel::Network(network) => network,
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
        step_index
    }

    /// The base model's distributions of the anchor's channels.
    pub(crate) fn base(&self) -> &[Distribution] {
        &self.distributions
    }

    /// The distribution of the next channel.
    pub(crate) fn next(&self, channel: usize) -> Distribution {
        let base = self.distributions[channel];
        match &self.model.regression {
            None => base,
            Some(regression) => regression.corrected(channel, base, &self.residuals),
        }
    }

    /// Tells the symbol of that channel, or that it is not coded; every channel must be told in turn.
    pub(crate) fn observe(&mut self, channel: usize, symbol: Option<i32>) {
        if self.model.regression.is_some() {
            self.residuals.push(residual(self.distributions[channel], symbol));
        }
    }
}
