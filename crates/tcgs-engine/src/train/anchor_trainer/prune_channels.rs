//! Prunes the channels and offset slots of the model in training that pictures do not need.

use super::AnchorTrainer;
use crate::{
    domain::{NearPlane, SceneScale},
    model::{AnchorRows, NetworkLayout},
    render::NeuralGaussians,
    train::{
        Moments, Result,
        channel_pruning::ChannelPruning,
        compression::Compression,
        feature_basis::{FeatureBasis, FeatureMoments},
        model_trainer::Views,
        sensitivity::feature_sensitivity,
    },
};

impl AnchorTrainer {
    /// Changes features to the basis that pictures and anchors suggest, and drops channels and offset slots that no picture needs
    /// (METHOD.md §4.12), if the model has quantization steps already.
    pub(super) fn prune_channels(&mut self, step: u32, views: &mut Views<'_>) -> Result<()> {
        let (state, statistics) = self.read()?;
        let Some(basis) = self.feature_basis(&state.anchors, views)? else { return Ok(()) };
        let used = state.anchors.masks.iter().fold(0, |used, mask| used | mask);
        let slots: Vec<usize> = (0..self.shape.offsets).filter(|slot| (used >> slot) & 1 == 1).collect();
        if slots.is_empty() {
            return Ok(());
        }
        let pruning = ChannelPruning { from: self.shape, basis, slots };
        let shape = pruning.shape();
        tracing::debug!(step, ?shape, "channels were pruned");
        let state = pruning.anchors(state);
        let moments = &self.network_moments;
        let networks = [&self.device_anchors.networks, &moments.first, &moments.second];
        let [first, second, third] = networks.map(|buffer| self.device.read(buffer));
        let [networks, first, second] = pruning.networks([first?, second?, third?]);
        self.shape = shape;
        self.layout = NetworkLayout::new(shape);
        self.owners = self.layout.owners();
        self.device_anchors.networks = self.device.upload("networks", &networks)?;
        self.network_moments = Moments::upload(&self.device, &first, &second)?;
        let near = NearPlane::of_extent(self.extent).depth();
        self.neural = NeuralGaussians::new(self.device.clone(), shape, near, SceneScale::DEFAULT)?;
        self.rendered = false;
        if let Some(compression) = &mut self.compression {
            compression.prune_channels(&pruning, &state.anchors)?;
        }
        self.write(state, &pruning.statistics(&statistics), step)
    }

    /// Lets the estimate of the file's size expect the bits that channel pruning will save.
    pub(super) fn estimate_channel_pruning(&mut self, views: &mut Views<'_>) -> Result<()> {
        let (state, _) = self.read()?;
        let basis = self.feature_basis(&state.anchors, views)?;
        if let (Some(compression), Some(basis)) = (&mut self.compression, basis) {
            compression.expect_feature_share(basis.bits_share);
        }
        Ok(())
    }

    /// The basis of the features of `anchors`, those on the device; none before the first noise.
    fn feature_basis(&mut self, anchors: &AnchorRows, views: &mut Views<'_>) -> Result<Option<FeatureBasis>> {
        let quant_step = self.compression.as_ref().map(Compression::mean_feature_step).transpose()?.flatten();
        let Some(quant_step) = quant_step else { return Ok(None) };
        let Self { device, neural, device_anchors, gradients, .. } = self;
        let sensitivity = feature_sensitivity(device, neural, device_anchors, gradients, views)?;
        let rows = (0..anchors.len()).map(|anchor| &anchors.row(anchor)[..anchors.shape.features]);
        let moments = FeatureMoments::of(rows, anchors.shape.features);
        Ok(FeatureBasis::of(&moments, &sensitivity, quant_step))
    }
}
