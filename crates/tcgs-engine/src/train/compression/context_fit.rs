//! Selects the context model of the last stage: the trained one, or one with fewer inputs or less to store.
//!
//! A scene is trained with the largest context model; in a small scene it saves fewer bytes than its planes and networks take. So
//! before everything is rounded, networks with the position or the anchor's own planes as their only input, and smaller planes, are
//! fitted to the current scene: by the rate term alone, without rendering, at the quantization steps that the anchors have. The model
//! with the fewest bytes, its own included, is trained further. It is selected before the rounding, since attributes converge to
//! multiples of their quantization steps, which other steps would undo.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::{
    Compression,
    context_model::{
        BYTES_PER_PARAMETER, ContextModel, QuantState, outputs_of, sample_of, set_initial_adjustments,
        stored_parameters, stored_pass,
    },
    frozen_quant_steps::FrozenQuantSteps,
    quant_steps::{adjustments_of, mean_quant_steps, static_adjustments},
    statistics::group_statistics,
};
use crate::{
    domain::{
        AttributeGroup, CancelFlag, ContextCandidates, ContextFrame, ContextKind, PlaneContext,
        context_model::{GroupNetworks, STEP_OCTAVES},
    },
    gpu::{Buffer, Recorder},
    model::AnchorRows,
    render::{DeviceAnchors, RenderError},
    train::{
        Adam, AdamStep, Decay, Result, SizeLimit, TrainError, TrainedContext,
        context::{
            ContextAnchors, ContextConfig, ContextLayout, ContextLearningRates, ContextNet, ContextState,
            GroupStatistics, PlaneConfig, Quantization, QuantizationPhase, RateInputs, RateTerm,
            sample_anchors, sample_size,
        },
    },
};

/// Rows of anchors as `[N][row]`, and their steps as `[N][3]`.
type RowsAndSteps = (Vec<f32>, Vec<f32>);

/// Largest number of anchors in the sample of one step of a fit.
const MAX_SAMPLED: usize = 4096;

/// Steps of a fit for each step of the run, and their bounds: a network settles in a few hundred.
const FIT_STEPS_PER_STEP: f64 = 1.0 / 6.0;
const MIN_FIT_STEPS: u32 = 10;
const MAX_FIT_STEPS: u32 = 600;

/// Learning rates of new networks, and of trained ones.
const FRESH: Decay = Decay::exponential(1e-2, 1e-4);
const TRAINED: Decay = Decay::exponential(1e-3, 1e-5);

/// Bound of the initial latents of smaller planes: a few of the stored multiples of 1/16.
const FIRST_LATENT: f32 = 0.25;

/// Smallest edge of planes that save more than they cost.
const MIN_EDGE: usize = 8;

/// The inputs and buffers that all fits share.
pub(super) struct ContextFit<'a> {
    pub(super) compression: &'a Compression,
    pub(super) quant: &'a QuantState,
    pub(super) context_model: &'a ContextModel,
    pub(super) anchors: &'a DeviceAnchors,
    pub(super) rows: &'a AnchorRows,
    adam: &'a Adam,
    frozen: FrozenQuantSteps,
    /// Mean of the anchors' step adjustments, in octaves.
    usual: [f32; 3],
    /// The attributes' statistics as they are now.
    statistics: [GroupStatistics; 3],
    rate: RateTerm,
    overflow_flag: Buffer<u32>,
    d_rows: Buffer<f32>,
    steps: u32,
    sampled: f64,
    pub(super) cancel: &'a CancelFlag,
}

impl Compression {
    /// Replaces the context model by the selected one, for the anchors `rows`, and fits quantization steps to `limit`, if given; does
    /// nothing before the context model learns.
    pub(super) fn select_context(
        &mut self,
        adam: &Adam,
        anchors: &DeviceAnchors,
        rows: &AnchorRows,
        limit: Option<SizeLimit>,
        cancel: &CancelFlag,
    ) -> Result<()> {
        let Some(context_model) = &self.context_model else { return Ok(()) };
        let mut recorder = self.device.recorder("latents of planes");
        context_model.net.latents_from_planes(&mut recorder)?;
        recorder.submit()?;
        let steps = (f64::from(self.schedule.steps) * FIT_STEPS_PER_STEP) as u32;
        let steps = steps.clamp(MIN_FIT_STEPS, MAX_FIT_STEPS);
        let Some(fit) = self.context_fit(adam, anchors, rows, steps, cancel)? else { return Ok(()) };
        let mut net = fit.cheapest()?;
        if let Some(limit) = limit {
            net = fit.within(net, &limit)?;
        }
        let statistics = fit.statistics;
        if let Some(context_model) = &mut self.context_model {
            context_model.net = net;
            context_model.statistics = statistics;
            context_model.renewed = false;
        }
        Ok(())
    }

    /// A fit of context models, in `steps` steps each, to the anchors `rows`, those of `anchors`; none before the context model learns.
    pub(super) fn context_fit<'a>(
        &'a self,
        adam: &'a Adam,
        anchors: &'a DeviceAnchors,
        rows: &'a AnchorRows,
        steps: u32,
        cancel: &'a CancelFlag,
    ) -> Result<Option<ContextFit<'a>>> {
        let (Some(quant), Some(context_model)) = (&self.quant, &self.context_model) else { return Ok(None) };
        let device = &self.device;
        let share = self.schedule.sample_share.min(MAX_SAMPLED as f64 / rows.len().max(1) as f64);
        let capacity = ContextNet::capacity(sample_size(rows.len(), share));
        let usual = mean_quant_steps(&device.read(quant.rows.steps())?);
        Ok(Some(ContextFit {
            compression: self,
            quant,
            context_model,
            anchors,
            rows,
            adam,
            frozen: FrozenQuantSteps::new(device, capacity)?,
            usual: adjustments_of(usual, quant.base),
            statistics: group_statistics(rows, quant.base),
            rate: RateTerm::plan(anchors.shape, capacity).make(device)?,
            overflow_flag: device.buffer("never set", 1)?,
            d_rows: device.buffer("unused gradients of rows", anchors.rows.len())?,
            steps,
            sampled: share,
            cancel,
        }))
    }

    /// Refreshes every anchor's quantization steps and quantizes its row with them, as the file stores it.
    pub(super) fn final_rows(
        &mut self,
        anchors: &DeviceAnchors,
        cells: &[[i32; 3]],
    ) -> Result<Option<RowsAndSteps>> {
        let (Some(quant), Some(model)) = (&self.quant, &mut self.context_model) else { return Ok(None) };
        let device = &self.device;
        let (overflow_flag, d_rows) =
            (device.buffer("never set", 1)?, device.buffer("unused", anchors.rows.len())?);
        let quantization = rounding(quant);
        let all: Vec<u32> = (0..cells.len() as u32).collect();
        for sample in all.chunks(model.rate.capacity().max(1)) {
            let mut recorder = device.recorder("quantization steps of the scene");
            model.net.forward(&mut recorder, sample, &stored_pass(false))?;
            let inputs = RateInputs {
                anchors,
                quantized: &quant.rows,
                quantization: &quantization,
                sample: sample_of(&model.net, sample.len()),
                outputs: outputs_of(&model.net),
                lambda: 0.0,
            };
            model.rate.record(&mut recorder, &inputs, &d_rows, &overflow_flag)?;
            recorder.submit()?;
        }
        let mut recorder = device.recorder("rows of the scene");
        quant.rows.record_forward(&mut recorder, anchors, &quantization)?;
        recorder.submit()?;
        Ok(Some((device.read(quant.rows.rows())?, device.read(quant.rows.steps())?)))
    }

    /// The context models that an encoder may select for the finished scene, whose anchors have these quantization steps.
    pub(super) fn candidates(&self, steps: &[f32]) -> Result<Option<TrainedContext>> {
        let (Some(quant), Some(context_model)) = (&self.quant, &self.context_model) else {
            return Ok(None);
        };
        let layout = context_model.net.layout();
        let values = context_model.net.save()?.values;
        let candidates = candidates_of(layout, &values, context_model.frame, (steps, quant.base));
        let usual = mean_quant_steps(steps);
        tracing::debug!(kind = ?layout.config.kind, base = ?quant.base, ?usual, "steps");
        Ok(Some(TrainedContext { base_quant_steps: quant.base_quant_steps, candidates }))
    }
}

/// What an encoder may select with a context model: it, or tables at steps for all anchors, those of `steps` over their base.
pub(super) fn candidates_of(
    layout: &ContextLayout,
    values: &[f32],
    frame: ContextFrame,
    (steps, base): (&[f32], [f32; 3]),
) -> ContextCandidates {
    let (position, planes) = stored_contexts(layout, values);
    // Tables have one step for all anchors, which training did not round with.
    let static_steps = static_adjustments(steps, base, STEP_OCTAVES);
    let static_steps = static_steps.map(|octaves| (octaves - UNTRAINED).max(-STEP_OCTAVES));
    ContextCandidates { frame, static_steps, position, planes: planes.into_iter().collect() }
}

/// The networks and the planes of a context model, as an encoder is given them.
pub(super) fn stored_contexts(
    layout: &ContextLayout,
    values: &[f32],
) -> (GroupNetworks, Option<PlaneContext>) {
    let networks: GroupNetworks = AttributeGroup::ALL.map(|group| Some(layout.network(values, group)));
    let none = GroupNetworks::default();
    let (position, own, neighbors) = match layout.config.kind {
        ContextKind::Position => (networks, none.clone(), none),
        ContextKind::TriPlane => (none.clone(), networks, none),
        ContextKind::TriPlaneKnn => (none.clone(), none, networks),
    };
    let planes = layout.stored_planes(values).map(|planes| PlaneContext { planes, own, neighbors });
    (position, planes)
}

/// Octaves by which quantization steps that training did not use are finer than those that it used: the error of a second rounding
/// adds to the first, and training has not compensated for it.
const UNTRAINED: f32 = 0.5;

/// Rounding at each anchor's own steps.
fn rounding(quant: &QuantState) -> Quantization {
    Quantization { phase: QuantizationPhase::Rounded, base_quant_steps: quant.base, key: 0 }
}

impl ContextFit<'_> {
    /// A newly initialized model with planes of its own, fitted to the scene.
    pub(super) fn fitted(&self, config: ContextConfig) -> Result<ContextNet> {
        let mut net = self.fresh(config, None)?;
        self.fit(&mut net, true, FRESH)?;
        Ok(net)
    }

    fn cheapest(&self) -> Result<ContextNet> {
        let trained = &self.context_model.net;
        let config = trained.layout().config;
        let values = trained.save()?.values;
        let mut best: Option<(f64, ContextNet)> = None;
        let mut add = |what: &str, mut net: ContextNet, planes_learn: bool, rates: Decay| {
            self.fit(&mut net, planes_learn, rates)?;
            let bytes = self.bytes(&mut net)?;
            tracing::debug!(anchors = self.rows.len(), ?bytes, "attributes and model with {what}");
            let bytes = bytes.iter().sum::<f64>();
            // The first of equals, which is the trained one.
            if best.as_ref().is_none_or(|(min, _)| bytes < *min) {
                best = Some((bytes, net));
            }
            Ok::<_, TrainError>(())
        };
        let rates = if self.context_model.renewed { FRESH } else { TRAINED };
        add("the trained context", self.model(config, values.clone())?, false, rates)?;
        if config.kind != ContextKind::Position {
            let position = ContextConfig { kind: ContextKind::Position, ..config };
            add("positions", self.fresh(position, None)?, false, FRESH)?;
            if let Some(planes) = smaller(config.planes) {
                add("smaller planes", self.fresh(ContextConfig { planes, ..config }, None)?, true, FRESH)?;
            }
        }
        if config.kind == ContextKind::TriPlaneKnn {
            let own = ContextConfig { kind: ContextKind::TriPlane, ..config };
            add("the own planes", self.fresh(own, Some((trained.layout(), &values)))?, false, FRESH)?;
        }
        best.map(|(_, net)| net).ok_or_else(|| RenderError::OutOfStep.into())
    }

    /// Bytes of the groups' attributes, then of what the model stores.
    fn bytes(&self, net: &mut ContextNet) -> Result<[f64; 4]> {
        let device = &self.compression.device;
        let all: Vec<u32> = (0..self.rows.len() as u32).collect();
        let mut bytes = [0.0, 0.0, 0.0, BYTES_PER_PARAMETER * stored_parameters(net.layout()) as f64];
        let mut readings = Vec::new();
        for sample in all.chunks(self.rate.capacity().max(1)) {
            let mut recorder = device.recorder("rate of the scene");
            self.record(&mut recorder, net, sample, false)?;
            readings.push(recorder.submit_reading(&[self.rate.bits_by_group()])?);
        }
        for reading in readings {
            let sums = RateTerm::sums_of(bytemuck::cast_slice(&reading.wait(device)?[0]));
            bytes.iter_mut().zip(sums).for_each(|(bytes, bits)| *bytes += bits / 8.0);
        }
        Ok(bytes)
    }

    /// A newly initialized model, with its own planes or those of another.
    fn fresh(&self, config: ContextConfig, planes: Option<(&ContextLayout, &[f32])>) -> Result<ContextNet> {
        let layout = ContextLayout::new(config)?;
        let mut rng = Pcg64::seed_from_u64(self.compression.schedule.seed);
        let mut values = layout.initial(&self.statistics, &mut rng)?;
        set_initial_adjustments(&layout, self.usual, &mut values);
        match planes {
            Some((other, from)) => layout.copy_planes(&mut values, other, from)?,
            None => values[layout.latents.clone()]
                .iter_mut()
                .for_each(|value| *value = rng.random_range(-FIRST_LATENT..FIRST_LATENT)),
        }
        self.model(config, values)
    }

    /// A model of the scene with zero moments.
    pub(super) fn model(&self, config: ContextConfig, values: Vec<f32>) -> Result<ContextNet> {
        let mut net = ContextNet::new(&self.compression.device, config, &ContextState::new(values))?;
        net.place(&ContextAnchors::new(&config, &self.context_model.frame, &self.rows.cells))?;
        Ok(net)
    }

    /// Fits a model to the scene.
    fn fit(&self, net: &mut ContextNet, planes_learn: bool, decay: Decay) -> Result<()> {
        let device = &self.compression.device;
        for step in 1..=self.steps {
            if self.cancel.is_cancelled() {
                return Err(TrainError::Cancelled);
            }
            let seed = self.compression.schedule.seed;
            let sample = sample_anchors(seed, step, self.rows.len(), self.sampled);
            let mut recorder = device.recorder("fit of a context");
            self.record(&mut recorder, net, &sample, planes_learn)?;
            net.backward(&mut recorder)?;
            let rate = decay.at(f64::from(step) / f64::from(self.steps)) as f32;
            let rates = ContextLearningRates { networks: rate, planes: rate, layers: rate, latents: rate };
            let adam_step = AdamStep { number: step, overflow_flag: &self.overflow_flag };
            net.step(&mut recorder, self.adam, adam_step, &rates, &self.statistics)?;
            recorder.submit()?;
            if step.is_multiple_of(WAIT_INTERVAL) {
                device.wait()?;
            }
        }
        Ok(())
    }

    /// Records what a sample costs at the steps that its anchors have, with the gradients by a model's outputs.
    fn record(
        &self,
        recorder: &mut Recorder<'_>,
        net: &mut ContextNet,
        sample: &[u32],
        planes_learn: bool,
    ) -> Result<()> {
        net.forward(recorder, sample, &stored_pass(planes_learn))?;
        let QuantState { base, rows, .. } = self.quant;
        let channels = net.layout().config.channels;
        let (of_sample, outputs) = (sample_of(net, sample.len()), outputs_of(net));
        self.frozen.record(recorder, *base, rows.steps(), of_sample, outputs, channels)?;
        let inputs = RateInputs {
            anchors: self.anchors,
            quantized: rows,
            quantization: &rounding(self.quant),
            sample: of_sample,
            outputs,
            lambda: 1.0,
        };
        self.rate.record(recorder, &inputs, &self.d_rows, &self.overflow_flag)?;
        // A difference of one octave from the anchor's step weighs as much as one bit per attribute.
        let bit = self.rate.weight(1.0, sample.len());
        let weights = channels.map(|channels| bit * channels as f32);
        self.frozen.record_gradient(recorder, weights, of_sample, outputs, channels)?;
        Ok(())
    }
}

/// Steps of a fit between two waits for the device, which bounds the recorded work.
const WAIT_INTERVAL: u32 = 16;

/// Planes of half the edge.
fn smaller(planes: PlaneConfig) -> Option<PlaneConfig> {
    let smaller = PlaneConfig { edge: planes.edge / 2, ..planes };
    (smaller.edge >= MIN_EDGE).then_some(smaller)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::context::GroupStatistics;

    #[test]
    fn models_that_begin_anew_begin_at_the_steps_that_anchors_have() {
        let channels = [4, 6, 6];
        let config = ContextConfig::for_anchors(ContextKind::Position, channels, 100);
        let layout = ContextLayout::new(config).expect("a model");
        let statistics = channels
            .map(|channels| GroupStatistics { means: vec![0.5; channels], deviations: vec![2.0; channels] });
        let mut values = layout.initial(&statistics, &mut Pcg64::seed_from_u64(1)).expect("values");
        let before = values.clone();
        set_initial_adjustments(&layout, [1.25, -2.0, 0.5], &mut values);
        for ((head, octaves), channels) in layout.heads.iter().zip([1.25, -2.0, 0.5]).zip(channels) {
            assert_eq!(values[head.bias + 2 * channels], octaves);
        }
        let changed = values.iter().zip(&before).filter(|(now, before)| now != before).count();
        assert_eq!(changed, 3, "means and deviations stay");
    }
}
