//! Compression-aware training: rendering and loss see the scene as its file will store it (METHOD.md §4.2).
//!
//! Rendering uses attributes as the decoder will, first with noise and at last rounded; each step estimates the bits of a sample
//! of the anchors, and the context model learns with them.
//!
//! Invariants: a step that overflowed leaves nothing behind; noise and samples follow from seed and step; each stage allocates
//! what it needs when it starts.

mod checkpoint;
mod context_fit;
mod context_model;
mod finished;
mod frozen_quant_steps;
mod pruned_context;
mod quant_step_fit;
mod quant_steps;
mod statistics;

pub use finished::{ContextFitSettings, fit_contexts};

use std::sync::Arc;

use rand::SeedableRng;
use rand_pcg::Pcg64;

use context_model::{
    BYTES_PER_PARAMETER, ContextModel, QuantState, outputs_of, sample_of, set_initial_adjustments,
    stored_parameters, stored_pass,
};
use pruned_context::copy_kept_channels;
use quant_steps::{carry_quant_steps, mean_quant_steps};
use statistics::group_statistics;

use crate::{
    codec::context::robust_frame,
    domain::{CancelFlag, ContextFrame, ContextKind},
    gpu::{Buffer, Device, Recorder, buffer_bytes},
    model::{AnchorRows, ModelShape, NetworkLayout},
    render::DeviceAnchors,
    train::{
        Adam, AdamStep, BaseQuantSteps, CompressionSchedule, CompressionStage, OffsetMasks, Result,
        SizeLimit, TrainedContext,
        channel_pruning::ChannelPruning,
        context::{
            ContextAnchors, ContextConfig, ContextLayout, ContextLearningRates, ContextNet, ContextPass,
            ContextState, GroupStatistics, PlaneSource, Quantization, QuantizationPhase, QuantizedRows,
            RateInputs, RateTerm, RoundedNetworks, sample_anchors, sample_size,
        },
        model_trainer::Step,
    },
};

/// Compression-aware training of a scene.
#[derive(Debug)]
pub(in crate::train) struct Compression {
    device: Arc<Device>,
    schedule: CompressionSchedule,
    layout: NetworkLayout,
    quant: Option<QuantState>,
    context_model: Option<ContextModel>,
    /// The expected bits of features after channel pruning over those before it, once estimated; none after it.
    feature_share: Option<f64>,
}

/// Channels of the three attribute groups.
fn group_channels(shape: ModelShape) -> [usize; 3] {
    [shape.features, shape.offset_column() - shape.scaling_column(), 3 * shape.offsets]
}

/// The context model's sizes for a scene of `anchors` anchors.
fn config(schedule: &CompressionSchedule, shape: ModelShape, anchors: usize) -> ContextConfig {
    let mut config = ContextConfig::for_anchors(schedule.kind, group_channels(shape), anchors);
    if !schedule.compresses_planes {
        config.planes = config.planes.without_layers();
    }
    config
}

impl Compression {
    /// The state before the first step.
    pub(in crate::train) fn new(
        device: &Arc<Device>,
        schedule: CompressionSchedule,
        shape: ModelShape,
    ) -> Self {
        let layout = NetworkLayout::new(shape);
        Self {
            device: Arc::clone(device),
            schedule,
            layout,
            quant: None,
            context_model: None,
            feature_share: None,
        }
    }

    /// Whether another stage starts after `step`.
    pub(in crate::train) fn changes_stage_after(&self, step: u32) -> bool {
        self.schedule.changes_stage_after(step)
    }

    /// Whether everything is rounded from the step after `step` on.
    pub(in crate::train) fn starts_rounding_after(&self, step: u32) -> bool {
        self.changes_stage_after(step) && self.schedule.stage(step + 1) == CompressionStage::Rounded
    }

    /// From now on the bits of features are estimated as this share of those that they take.
    pub(in crate::train) fn expect_feature_share(&mut self, share: f64) {
        // As a checkpoint holds it, so that a resumed run estimates alike.
        self.feature_share = Some(f64::from(share as f32));
    }

    /// The geometric mean of the anchors' quantization steps of features; none before the first noise.
    pub(in crate::train) fn mean_feature_step(&self) -> Result<Option<f64>> {
        let Some(quant) = &self.quant else { return Ok(None) };
        let [features, ..] = mean_quant_steps(&self.device.read(quant.rows.steps())?);
        Ok(Some(f64::from(features)))
    }

    /// Follows the model's change to the shape of `anchors`, in their order. Quantization steps stay.
    pub(in crate::train) fn prune_channels(
        &mut self,
        pruning: &ChannelPruning,
        anchors: &AnchorRows,
    ) -> Result<()> {
        self.layout = NetworkLayout::new(anchors.shape);
        self.feature_share = None;
        let Some(QuantState { base_quant_steps, base, rows, .. }) = &self.quant else { return Ok(()) };
        let (base_quant_steps, base) = (*base_quant_steps, *base);
        let steps = self.device.read(rows.steps())?;
        self.quantize(base_quant_steps, base, &steps)?;
        if let Some(old) = self.context_model.take() {
            let old_layout = old.net.layout();
            let config = ContextConfig { channels: group_channels(anchors.shape), ..old_layout.config };
            let layout = ContextLayout::new(config)?;
            let statistics = group_statistics(anchors, base);
            let mut values = layout.initial(&statistics, &mut Pcg64::seed_from_u64(self.schedule.seed))?;
            let trained = old.net.save()?.values;
            copy_kept_channels(pruning, base[0], (old_layout, &trained), (&layout, &mut values))?;
            let state = ContextState::new(values);
            let model = self.context_model_of(config, &state, old.frame, statistics, &anchors.cells)?;
            self.context_model = Some(ContextModel { renewed: true, ..model });
        }
        Ok(())
    }

    /// Prepares the stages that start after `step` for the scene `anchors`. Short runs may skip a stage. With `limit`, quantization steps
    /// are fitted to it before everything is rounded.
    pub(in crate::train) fn enter_stage(
        &mut self,
        step: u32,
        adam: &Adam,
        anchors: &AnchorRows,
        device_anchors: &DeviceAnchors,
        limit: Option<SizeLimit>,
        cancel: &CancelFlag,
    ) -> Result<()> {
        let next = self.schedule.stage(step + 1);
        if next >= CompressionStage::Noise && self.quant.is_none()
            || next >= CompressionStage::Context && self.context_model.is_none()
        {
            let base_quant_steps = BaseQuantSteps::of(self.schedule.base, anchors);
            let base = base_quant_steps.in_world(anchors.lattice.voxel);
            let first = base.map(|step| step * (-self.schedule.base.finer_octaves()).exp2());
            self.quantize(base_quant_steps, base, &first.repeat(anchors.len()))?;
            tracing::debug!(step, ?base_quant_steps);
        }
        if next >= CompressionStage::Context && self.context_model.is_none() {
            self.model(anchors)?;
        }
        if next == CompressionStage::Rounded {
            self.select_context(adam, device_anchors, anchors, limit, cancel)?;
        }
        Ok(())
    }

    /// Replaces the rows of `anchors` by their quantized values and returns the encoder's input. `before` are the cells before
    /// pruning. Returns `None` if the run ended before the context model was trained; the rows are then unchanged.
    pub(in crate::train) fn finish(
        mut self,
        adam: &Adam,
        before: &[[i32; 3]],
        anchors: &mut AnchorRows,
        networks: &[f32],
        cancel: &CancelFlag,
    ) -> Result<Option<TrainedContext>> {
        self.replace(before, anchors)?;
        let device_anchors = DeviceAnchors::upload(&self.device, anchors, networks)?;
        if self.schedule.stage(self.schedule.steps) != CompressionStage::Rounded {
            self.select_context(adam, &device_anchors, anchors, None, cancel)?;
        }
        let Some((rows, steps)) = self.final_rows(&device_anchors, &anchors.cells)? else { return Ok(None) };
        anchors.values = rows;
        self.candidates(&steps)
    }

    fn quantize(
        &mut self,
        base_quant_steps: BaseQuantSteps,
        base: [f32; 3],
        of_anchors: &[f32],
    ) -> Result<()> {
        let rows = QuantizedRows::upload(&self.device, self.layout.shape, of_anchors)?;
        let networks = RoundedNetworks::plan(&self.layout).make(&self.device)?;
        self.quant = Some(QuantState { base_quant_steps, base, rows, networks });
        Ok(())
    }

    fn model(&mut self, anchors: &AnchorRows) -> Result<()> {
        let Some(quant) = &self.quant else { return Ok(()) };
        let shape = self.layout.shape;
        let statistics = group_statistics(anchors, quant.base);
        let config = config(&self.schedule, shape, anchors.len());
        let layout = ContextLayout::new(config)?;
        // A generator of its own, so that the model's size does not affect the rest of the run.
        let mut rng = Pcg64::seed_from_u64(self.schedule.seed);
        let mut values = layout.initial(&statistics, &mut rng)?;
        set_initial_adjustments(&layout, [-self.schedule.base.finer_octaves(); 3], &mut values);
        let state = ContextState::new(values);
        let frame = robust_frame(&anchors.cells);
        self.context_model =
            Some(self.context_model_of(config, &state, frame, statistics, &anchors.cells)?);
        Ok(())
    }

    fn context_model_of(
        &self,
        config: ContextConfig,
        state: &ContextState,
        frame: ContextFrame,
        statistics: [GroupStatistics; 3],
        cells: &[[i32; 3]],
    ) -> Result<ContextModel> {
        let mut net = ContextNet::new(&self.device, config, state)?;
        net.place(&ContextAnchors::new(&config, &frame, cells))?;
        let rate = self.rate_for(cells.len())?;
        Ok(ContextModel { frame, statistics, net, rate, sampled: 0, renewed: false })
    }

    fn rate_for(&self, anchors: usize) -> Result<RateTerm> {
        Ok(RateTerm::plan(self.layout.shape, self.rate_capacity(anchors)).make(&self.device)?)
    }

    /// Room for the samples of `anchors` anchors and of a few more.
    fn rate_capacity(&self, anchors: usize) -> usize {
        ContextNet::capacity(sample_size(anchors, self.schedule.sample_share))
    }

    /// Updates the state after growth or pruning: the anchors at the cells `before` are now `anchors`.
    pub(in crate::train) fn replace(&mut self, before: &[[i32; 3]], anchors: &AnchorRows) -> Result<()> {
        if let Some(QuantState { base_quant_steps, base, rows, .. }) = &self.quant {
            let (base_quant_steps, base) = (*base_quant_steps, *base);
            let old = self.device.read(rows.steps())?;
            let of_anchors = carry_quant_steps(before, &old, mean_quant_steps(&old), &anchors.cells);
            self.quantize(base_quant_steps, base, &of_anchors)?;
        }
        if let Some(mut context_model) = self.context_model.take() {
            let config = context_model.net.layout().config;
            context_model.net.place(&ContextAnchors::new(&config, &context_model.frame, &anchors.cells))?;
            if sample_size(anchors.len(), self.schedule.sample_share) > context_model.rate.capacity() {
                let capacity = self.rate_capacity(anchors.len());
                context_model.rate = context_model.rate.with_capacity(&self.device, capacity)?;
            }
            self.context_model = Some(context_model);
        }
        Ok(())
    }

    /// The quantization of `step`; none before the first noise.
    fn quantization(&self, step: u32) -> Option<Quantization> {
        let phase = match self.schedule.stage(step) {
            CompressionStage::Plain => return None,
            CompressionStage::Noise => QuantizationPhase::FixedNoise,
            CompressionStage::Context => QuantizationPhase::Noise,
            CompressionStage::Rounded => QuantizationPhase::Rounded,
        };
        let mut base_quant_steps = self.quant.as_ref()?.base;
        if phase == QuantizationPhase::FixedNoise {
            base_quant_steps =
                base_quant_steps.map(|step| step * (-self.schedule.base.finer_octaves()).exp2());
        }
        Some(Quantization { phase, base_quant_steps, key: Quantization::key(self.schedule.seed, step) })
    }

    /// Records the quantized anchors that `step` renders; none if it renders them unquantized.
    pub(in crate::train) fn forward(
        &self,
        recorder: &mut Recorder<'_>,
        anchors: &DeviceAnchors,
        step: u32,
    ) -> Result<Option<DeviceAnchors>> {
        let (Some(quant), Some(quantization)) = (&self.quant, self.quantization(step)) else {
            return Ok(None);
        };
        quant.rows.record_forward(recorder, anchors, &quantization)?;
        let mut shown = quant.rows.rendered(anchors);
        if self.schedule.stage(step) == CompressionStage::Rounded {
            quant.networks.record(recorder, &anchors.networks)?;
            shown.networks = quant.networks.parameters().clone();
        }
        Ok(Some(shown))
    }

    /// The context model's pass in `step`.
    fn pass(&self, step: u32) -> ContextPass {
        let schedule = &self.schedule;
        if schedule.stage(step) == CompressionStage::Rounded {
            return stored_pass(true);
        }
        let source = if schedule.compresses_planes && step >= schedule.reconstruct_from {
            PlaneSource::Reconstructed
        } else {
            PlaneSource::Raw
        };
        ContextPass {
            source,
            reconstruction: schedule.reconstruction_at(step),
            levels: None,
            planes_learn: true,
        }
    }

    /// Turns `d_rows`, the gradients by the rendered rows, into those by the anchors' rows, adds those of the rate term, and records
    /// the context model's optimizer step.
    pub(in crate::train) fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        adam: &Adam,
        anchors: &DeviceAnchors,
        step: &Step,
        d_rows: &Buffer<f32>,
        overflow_flag: &Buffer<u32>,
    ) -> Result<()> {
        let Some(quantization) = self.quantization(step.number) else { return Ok(()) };
        let pass = self.pass(step.number);
        let Self { quant: Some(quant), context_model, schedule, .. } = self else { return Ok(()) };
        quant.rows.record_backward(recorder, anchors, &quantization, d_rows)?;
        let Some(model) = context_model else { return Ok(()) };
        let sample = sample_anchors(schedule.seed, step.number, anchors.count, schedule.sample_share);
        model.sampled = sample.len();
        model.net.forward(recorder, &sample, &pass)?;
        let inputs = RateInputs {
            anchors,
            quantized: &quant.rows,
            quantization: &quantization,
            sample: sample_of(&model.net, model.sampled),
            outputs: outputs_of(&model.net),
            lambda: step.lambda,
        };
        model.rate.record(recorder, &inputs, d_rows, overflow_flag)?;
        model.net.backward(recorder)?;
        let progress = schedule.context_progress(step.number);
        let planes = schedule.planes.at(progress) as f32;
        let rates = ContextLearningRates {
            networks: schedule.networks.at(progress) as f32,
            planes,
            layers: planes,
            latents: planes,
        };
        // The last stage starts with zero moments.
        let rounded = schedule.stage(step.number) == CompressionStage::Rounded;
        let number = step.number + 1 - if rounded { schedule.rounded_from } else { schedule.context_from };
        model.net.step(recorder, adam, AdamStep { number, overflow_flag }, &rates, &model.statistics)
    }

    /// Records the gradients of the last sample's bits by the offset masks.
    pub(in crate::train) fn mask_backward(
        &self,
        recorder: &mut Recorder<'_>,
        masks: &OffsetMasks,
        lambda: f64,
    ) -> Result<()> {
        if let Some(context_model) = &self.context_model {
            let sample = sample_of(&context_model.net, context_model.sampled);
            masks.rate_backward(recorder, &context_model.rate, sample, lambda)?;
        }
        Ok(())
    }

    /// Where the bits of the last sample are, by group; none before the context model learns.
    pub(in crate::train) fn sampled_bits(&self) -> Option<Buffer<f32>> {
        let model = self.context_model.as_ref().filter(|context_model| context_model.sampled > 0)?;
        Some(model.rate.bits_by_group().clone())
    }

    /// Mean bits of an anchor's attributes in the sample of `step`, whose `bits` are those of [`Self::sampled_bits`], and bytes of the
    /// context model; none before it learns.
    ///
    /// Until a context model is selected, its bytes are those of the model without planes and neighbors: the selected one has more
    /// only if it saves them elsewhere.
    pub(in crate::train) fn bitrate(&self, step: u32, bits: &[f32]) -> Result<Option<(f64, f64)>> {
        let Some(context_model) =
            self.context_model.as_ref().filter(|context_model| context_model.sampled > 0)
        else {
            return Ok(None);
        };
        let [features, scalings, offsets] = RateTerm::sums_of(bits);
        let bits = features * self.feature_share.unwrap_or(1.0) + scalings + offsets;
        let config = context_model.net.layout().config;
        let selected = self.schedule.stage(step) >= CompressionStage::Rounded;
        let kind = if selected { config.kind } else { ContextKind::Position };
        let stored = stored_parameters(&ContextLayout::new(ContextConfig { kind, ..config })?);
        Ok(Some((bits / context_model.sampled as f64, BYTES_PER_PARAMETER * stored as f64)))
    }
}

/// Bytes on the device of compression-aware training, at its largest: the fits after the last step have a model beside the
/// trained one, and rows and gradients of their own.
pub(in crate::train) fn compression_bytes(
    schedule: &CompressionSchedule,
    shape: ModelShape,
    anchors: usize,
) -> u64 {
    let sampled = sample_size(anchors, schedule.sample_share);
    let config = config(schedule, shape, anchors);
    let net = ContextNet::bytes(&config, anchors, ContextNet::capacity(sampled)).unwrap_or(u64::MAX / 8);
    QuantizedRows::plan(shape, anchors).bytes()
        + RoundedNetworks::plan(&NetworkLayout::new(shape)).bytes()
        + 2 * RateTerm::plan(shape, ContextNet::capacity(sampled)).bytes()
        + 3 * net
        + 2 * buffer_bytes::<f32>(anchors * shape.row())
}
