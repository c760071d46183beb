//! Narrows the model in training to the channels and offset slots that pictures need.

use super::AnchorTrainer;
use crate::{
    domain::{NearPlane, SceneScale},
    model::{AnchorRows, NetworkLayout},
    render::NeuralGaussians,
    train::{
        Moments, Result,
        compression::Compression,
        feature_basis::{FeatureBasis, FeatureMoments},
        model_trainer::Views,
        narrowing::Narrowing,
        sensitivity::feature_sensitivity,
    },
};

impl AnchorTrainer {
    /// Changes features to the basis that pictures and anchors suggest, and drops channels and offset slots that no picture needs
    /// (METHOD.md §4.12), if the model has quantization steps already.
    pub(super) fn narrow(&mut self, step: u32, views: &mut Views<'_>) -> Result<()> {
        let (state, statistics) = self.read()?;
        let Some(basis) = self.feature_basis(&state.anchors, views)? else { return Ok(()) };
        let used = state.anchors.masks.iter().fold(0, |used, mask| used | mask);
        let slots: Vec<usize> = (0..self.shape.offsets).filter(|slot| (used >> slot) & 1 == 1).collect();
        if slots.is_empty() {
            return Ok(());
        }
        let narrowing = Narrowing { from: self.shape, basis, slots };
        let shape = narrowing.shape();
        tracing::debug!(step, ?shape, "the model is narrower");
        let state = narrowing.anchors(state);
        let moments = &self.network_moments;
        let networks = [&self.device_anchors.networks, &moments.first, &moments.second];
        let [first, second, third] = networks.map(|buffer| self.device.read(buffer));
        let [networks, first, second] = narrowing.networks([first?, second?, third?]);
        self.shape = shape;
        self.layout = NetworkLayout::new(shape);
        self.owners = self.layout.owners();
        self.device_anchors.networks = self.device.upload("networks", &networks)?;
        self.network_moments = Moments::upload(&self.device, &first, &second)?;
        let near = NearPlane::of_extent(self.extent).depth();
        self.neural = NeuralGaussians::new(self.device.clone(), shape, near, SceneScale::DEFAULT)?;
        self.rendered = false;
        if let Some(compression) = &mut self.compression {
            compression.narrow(&narrowing, &state.anchors)?;
        }
        self.write(state, &narrowing.statistics(&statistics), step)
    }

    /// Tells the estimate of the file's size what narrowing will save, before the model is narrowed.
    pub(super) fn estimate_narrowing(&mut self, views: &mut Views<'_>) -> Result<()> {
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
