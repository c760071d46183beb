//! What a step of compression-aware training does beside rendering: quantises the rows that are rendered, measures a sample's
//! rate, and lets the context model learn.
//!
//! What always holds: a step that turns out void leaves nothing of it behind; noise and samples follow from the seed and the
//! step; and what a stage needs is made when it begins, so a run pays for no more than it uses.

use std::sync::Arc;

use rand::SeedableRng;
use rand_pcg::Pcg64;

use super::{
    context_fit::{BYTES_A_PARAMETER, begin_at, stored_parameters, stored_pass},
    quant_steps::{carry_steps, usual_steps},
    statistics::group_statistics,
};
use crate::{
    codec::context::robust_frame,
    domain::{CancelFlag, ContextFrame, ContextKind},
    gpu::{Buffer, Device, Recorder, buffer_bytes},
    model::{AnchorRows, NetworkLayout, Shape},
    render::DeviceAnchors,
    train::{
        Adam, BaseSteps, CheckpointError, CompressionSchedule, OffsetMasks, Stage, TrainError,
        TrainedContext,
        checkpoint::LearnerState,
        context::{
            AnchorSample, ContextAnchors, ContextConfig, ContextNet, ContextPass, ContextRates, ContextState,
            GroupOutputs, GroupStatistics, PlaneConfig, PlaneSource, Quantisation, QuantisationPhase,
            QuantisedRows, RateTerm, RoundedNetworks, sample_anchors,
        },
        model_trainer::Step,
    },
};

/// Largest integers of the weights that the last stage trains on: 8 bits.
pub(super) const LEVELS: u8 = 127;

/// What there is from the first noise on.
#[derive(Debug)]
pub(super) struct Quantising {
    /// In world units.
    pub(super) base: [f32; 3],
    pub(super) steps: BaseSteps,
    pub(super) rows: QuantisedRows,
    pub(super) networks: RoundedNetworks,
}

/// What there is once the context model learns.
#[derive(Debug)]
pub(super) struct Modelling {
    pub(super) frame: ContextFrame,
    pub(super) statistics: [GroupStatistics; 3],
    pub(super) net: ContextNet,
    pub(super) rate: RateTerm,
    /// Anchors of the last sample.
    pub(super) sampled: usize,
}

/// Compression-aware training of a scene.
#[derive(Debug)]
pub(in crate::train) struct Compression {
    pub(super) device: Arc<Device>,
    pub(super) schedule: CompressionSchedule,
    pub(super) layout: NetworkLayout,
    pub(super) quantising: Option<Quantising>,
    pub(super) modelling: Option<Modelling>,
}

/// Channels of the three attribute groups.
pub(super) fn group_channels(shape: Shape) -> [usize; 3] {
    [shape.features, shape.offset_column() - shape.scaling_column(), 3 * shape.offsets]
}

/// The context model's sizes for a scene of so many anchors.
pub(super) fn config(schedule: &CompressionSchedule, shape: Shape, anchors: usize) -> ContextConfig {
    let mut config = ContextConfig::for_anchors(schedule.kind, group_channels(shape), anchors);
    if !schedule.compresses_planes {
        config.planes = config.planes.without_layers();
    }
    config
}

impl Compression {
    /// Before the first step.
    pub(in crate::train) fn begin(device: &Arc<Device>, schedule: CompressionSchedule, shape: Shape) -> Self {
        let layout = NetworkLayout::new(shape);
        Self { device: Arc::clone(device), schedule, layout, quantising: None, modelling: None }
    }

    /// Whether another stage begins after `step`.
    pub(in crate::train) fn turns_after(&self, step: u32) -> bool {
        self.schedule.turns_after(step)
    }

    /// Whether everything is rounded from the step after `step` on.
    pub(in crate::train) fn rounds_after(&self, step: u32) -> bool {
        self.turns_after(step) && self.schedule.stage(step + 1) == Stage::Rounded
    }

    /// Makes what the stages that begin after `step` need of a scene whose rows are `anchors`. Short runs may pass over a stage.
    pub(in crate::train) fn turn(
        &mut self,
        step: u32,
        adam: &Adam,
        anchors: &AnchorRows,
        device_anchors: &DeviceAnchors,
        cancel: &CancelFlag,
    ) -> Result<(), TrainError> {
        let next = self.schedule.stage(step + 1);
        if next >= Stage::Noise && self.quantising.is_none()
            || next >= Stage::Context && self.modelling.is_none()
        {
            let steps = BaseSteps::of(self.schedule.base, anchors);
            let base = steps.in_world(anchors.lattice.voxel);
            let first = base.map(|step| step * (-self.schedule.base.finer()).exp2());
            self.quantise(steps, base, &first.repeat(anchors.len()))?;
            tracing::debug!(step, ?steps, "base steps");
        }
        if next >= Stage::Context && self.modelling.is_none() {
            self.model(anchors)?;
        }
        if next == Stage::Rounded
            && let Some(net) = self.choose(adam, device_anchors, &anchors.cells, cancel)?
            && let Some(modelling) = &mut self.modelling
        {
            modelling.net = net;
        }
        Ok(())
    }

    /// What the run found for the encoder, and the rows that the file is to hold: those of `anchors` as the last stage renders
    /// them. `before` has the cells that anchors were at before some were left out. None if the run was too short for a
    /// context model; then the rows stay as they are.
    pub(in crate::train) fn finish(
        mut self,
        adam: &Adam,
        before: &[[i32; 3]],
        anchors: &mut AnchorRows,
        networks: &[f32],
        cancel: &CancelFlag,
    ) -> Result<Option<TrainedContext>, TrainError> {
        self.replace(before, anchors)?;
        let device_anchors = DeviceAnchors::upload(&self.device, anchors, networks)?;
        if self.schedule.stage(self.schedule.steps) != Stage::Rounded
            && let Some(net) = self.choose(adam, &device_anchors, &anchors.cells, cancel)?
            && let Some(modelling) = &mut self.modelling
        {
            modelling.net = net;
        }
        let Some((rows, steps)) = self.settle(&device_anchors, &anchors.cells)? else { return Ok(None) };
        anchors.values = rows;
        self.candidates(&steps)
    }

    fn quantise(&mut self, steps: BaseSteps, base: [f32; 3], of_anchors: &[f32]) -> Result<(), TrainError> {
        let rows = QuantisedRows::upload(&self.device, self.layout.shape, of_anchors)?;
        let networks = RoundedNetworks::plan(&self.layout).make(&self.device)?;
        self.quantising = Some(Quantising { base, steps, rows, networks });
        Ok(())
    }

    fn model(&mut self, anchors: &AnchorRows) -> Result<(), TrainError> {
        let Some(quantising) = &self.quantising else { return Ok(()) };
        let shape = self.layout.shape;
        let statistics = group_statistics(anchors, quantising.base);
        let config = config(&self.schedule, shape, anchors.len());
        let layout = crate::train::context::ContextLayout::new(config)?;
        // Of its own: how many numbers a model needs must not decide how the scene goes on.
        let mut rng = Pcg64::seed_from_u64(self.schedule.seed);
        let mut values = layout.initial(&statistics, &mut rng)?;
        begin_at(&layout, [-self.schedule.base.finer(); 3], &mut values);
        let state = ContextState::new(values);
        let frame = robust_frame(&anchors.cells);
        self.modelling = Some(self.modelling_of(config, &state, frame, statistics, &anchors.cells)?);
        Ok(())
    }

    fn modelling_of(
        &self,
        config: ContextConfig,
        state: &ContextState,
        frame: ContextFrame,
        statistics: [GroupStatistics; 3],
        cells: &[[i32; 3]],
    ) -> Result<Modelling, TrainError> {
        let mut net = ContextNet::new(&self.device, config, state)?;
        net.place(&ContextAnchors::new(&config, &frame, cells))?;
        let rate = self.rate_for(cells.len())?;
        Ok(Modelling { frame, statistics, net, rate, sampled: 0 })
    }

    fn rate_for(&self, anchors: usize) -> Result<RateTerm, TrainError> {
        let capacity = ContextNet::capacity(sample_size(anchors, self.schedule.sampled));
        Ok(RateTerm::plan(self.layout.shape, capacity).make(&self.device)?)
    }

    /// Takes notice that anchors came or went: those of `before` are now `anchors`.
    pub(in crate::train) fn replace(
        &mut self,
        before: &[[i32; 3]],
        anchors: &AnchorRows,
    ) -> Result<(), TrainError> {
        if let Some(Quantising { steps, base, rows, .. }) = &self.quantising {
            let (steps, base) = (*steps, *base);
            let old = self.device.read(rows.steps())?;
            let of_anchors = carry_steps(before, &old, usual_steps(&old), &anchors.cells);
            self.quantise(steps, base, &of_anchors)?;
        }
        if let Some(mut modelling) = self.modelling.take() {
            let config = modelling.net.layout().config;
            modelling.net.place(&ContextAnchors::new(&config, &modelling.frame, &anchors.cells))?;
            if sample_size(anchors.len(), self.schedule.sampled) > modelling.rate.capacity() {
                modelling.rate = self.rate_for(anchors.len())?;
            }
            self.modelling = Some(modelling);
        }
        Ok(())
    }

    /// How the rows of `step` are quantised; none before the first noise.
    pub(super) fn quantisation(&self, step: u32) -> Option<Quantisation> {
        let phase = match self.schedule.stage(step) {
            Stage::Plain => return None,
            Stage::Noise => QuantisationPhase::FixedNoise,
            Stage::Context => QuantisationPhase::Noise,
            Stage::Rounded => QuantisationPhase::Rounded,
        };
        let mut base_steps = self.quantising.as_ref()?.base;
        if phase == QuantisationPhase::FixedNoise {
            base_steps = base_steps.map(|step| step * (-self.schedule.base.finer()).exp2());
        }
        Some(Quantisation { phase, base_steps, key: Quantisation::key(self.schedule.seed, step) })
    }

    /// Records what `step` renders of the anchors instead of their own rows and networks; none where it is those.
    pub(in crate::train) fn forward(
        &self,
        recorder: &mut Recorder<'_>,
        anchors: &DeviceAnchors,
        step: u32,
    ) -> Result<Option<DeviceAnchors>, TrainError> {
        let (Some(quantising), Some(quantisation)) = (&self.quantising, self.quantisation(step)) else {
            return Ok(None);
        };
        quantising.rows.record_forward(recorder, anchors, &quantisation)?;
        let mut shown = quantising.rows.rendered(anchors);
        if self.schedule.stage(step) == Stage::Rounded {
            quantising.networks.record(recorder, &anchors.networks)?;
            shown.networks = quantising.networks.parameters().clone();
        }
        Ok(Some(shown))
    }

    /// What the context model does in `step`.
    fn pass(&self, step: u32) -> ContextPass {
        let schedule = &self.schedule;
        if schedule.stage(step) == Stage::Rounded {
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

    /// Records the way back from `d_rows`, the gradients by the rows that were rendered, to those by the anchors' own with
    /// those of the rate; and the step of the context model.
    pub(in crate::train) fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        adam: &Adam,
        anchors: &DeviceAnchors,
        step: &Step,
        d_rows: &Buffer<f32>,
        overflow_flag: &Buffer<u32>,
    ) -> Result<(), TrainError> {
        let Some(quantisation) = self.quantisation(step.number) else { return Ok(()) };
        let pass = self.pass(step.number);
        let Self { quantising: Some(quantising), modelling, schedule, .. } = self else { return Ok(()) };
        quantising.rows.record_backward(recorder, anchors, &quantisation, d_rows)?;
        let Some(modelling) = modelling else { return Ok(()) };
        let sample = sample_anchors(schedule.seed, step.number, anchors.count, schedule.sampled);
        modelling.sampled = sample.len();
        modelling.net.forward(recorder, &sample, &pass)?;
        modelling.rate.record(
            recorder,
            anchors,
            &quantising.rows,
            &quantisation,
            sample_of(&modelling.net, modelling.sampled),
            outputs_of(&modelling.net),
            step.lambda,
            d_rows,
            overflow_flag,
        )?;
        modelling.net.backward(recorder)?;
        let learnt = schedule.learnt(step.number);
        let planes = schedule.planes.at(learnt) as f32;
        let rates = ContextRates {
            networks: schedule.networks.at(learnt) as f32,
            planes,
            layers: planes,
            latents: planes,
        };
        // The last stage begins with a model that remembers no gradient.
        let rounded = schedule.stage(step.number) == Stage::Rounded;
        let t = step.number + 1 - if rounded { schedule.rounded_from } else { schedule.context_from };
        modelling.net.step(recorder, adam, t, overflow_flag, &rates, &modelling.statistics)
    }

    /// Records what the last recorded sample's rate says of the offsets' masks.
    pub(in crate::train) fn mask_backward(
        &self,
        recorder: &mut Recorder<'_>,
        masks: &OffsetMasks,
        lambda: f64,
    ) -> Result<(), TrainError> {
        if let Some(modelling) = &self.modelling {
            let sample = sample_of(&modelling.net, modelling.sampled);
            masks.rate_backward(recorder, &modelling.rate, sample, lambda)?;
        }
        Ok(())
    }

    /// Bits of an anchor's attributes in the last submitted sample, and bytes of the context model; none before there is one.
    pub(in crate::train) fn rate(&self) -> Result<Option<(f64, f64)>, TrainError> {
        let Some(modelling) = self.modelling.as_ref().filter(|modelling| modelling.sampled > 0) else {
            return Ok(None);
        };
        let bits: f64 = modelling.rate.sums(&self.device)?.iter().sum();
        let layout = modelling.net.layout();
        let stored = stored_parameters(layout) as f64;
        Ok(Some((bits / modelling.sampled as f64, BYTES_A_PARAMETER * stored)))
    }
}

/// Bytes on the device of compression-aware training, at its largest: the fits after the last step have a model beside the
/// trained one, and rows and gradients of their own.
pub(in crate::train) fn compression_bytes(
    schedule: &CompressionSchedule,
    shape: Shape,
    anchors: usize,
) -> u64 {
    let sampled = sample_size(anchors, schedule.sampled);
    let config = config(schedule, shape, anchors);
    let net = ContextNet::bytes(&config, anchors, ContextNet::capacity(sampled)).unwrap_or(u64::MAX / 8);
    QuantisedRows::plan(shape, anchors).bytes()
        + RoundedNetworks::plan(&NetworkLayout::new(shape)).bytes()
        + 2 * RateTerm::plan(shape, ContextNet::capacity(sampled)).bytes()
        + 3 * net
        + 2 * buffer_bytes::<f32>(anchors * shape.row())
}

/// The anchors of a model's last recorded forward pass.
pub(super) fn sample_of(net: &ContextNet, count: usize) -> AnchorSample<'_> {
    AnchorSample { list: net.sample(), count, capacity: net.columns() }
}

/// What a model's last recorded forward pass says of them.
pub(super) fn outputs_of(net: &ContextNet) -> [GroupOutputs<'_>; 3] {
    let rows = net.layout().config.output_rows();
    std::array::from_fn(|group| GroupOutputs {
        values: net.outputs(),
        gradients: net.output_gradients(),
        first_row: rows[group],
    })
}

/// Anchors in a sample, at least one where there is any.
pub(super) fn sample_size(anchors: usize, share: f64) -> usize {
    ((anchors as f64 * share).ceil() as usize).clamp(anchors.min(1), anchors)
}

/// Checkpoints.
impl Compression {
    /// Adds everything that the next step depends on.
    pub(in crate::train) fn save(&self, state: &mut LearnerState) -> Result<(), TrainError> {
        let Some(quantising) = &self.quantising else { return Ok(()) };
        let BaseSteps { feature, scaling, offset } = quantising.steps;
        state.put("steps.base", vec![feature, scaling, offset]);
        state.put("steps", self.device.read(quantising.rows.steps())?);
        let Some(modelling) = &self.modelling else { return Ok(()) };
        let config = &modelling.net.layout().config;
        let PlaneConfig { edge, channels, layers, hidden, latents } = config.planes;
        let sizes =
            [config.kind as usize, edge, channels, layers, hidden, latents].into_iter().chain(config.hidden);
        state.put("context.sizes", sizes.map(|size| size as u32).collect());
        state.put("context.centre", modelling.frame.centre.to_vec());
        state.put("context.half", modelling.frame.half.to_vec());
        let statistics = |values: fn(&GroupStatistics) -> &Vec<f32>| {
            modelling.statistics.iter().flat_map(|group| values(group).clone()).collect::<Vec<f32>>()
        };
        state.put("context.means", statistics(|group| &group.means));
        state.put("context.deviations", statistics(|group| &group.deviations));
        let ContextState { values, first, second } = modelling.net.save()?;
        state.put("context", values);
        state.put("context.first", first);
        state.put("context.second", second);
        Ok(())
    }

    /// The compression that [`Self::save`] was asked of, for the anchors that go with it.
    pub(in crate::train) fn resume(
        device: &Arc<Device>,
        schedule: CompressionSchedule,
        anchors: &AnchorRows,
        state: &mut LearnerState,
    ) -> Result<Self, TrainError> {
        let mut resumed = Self::begin(device, schedule, anchors.shape);
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
        let steps = BaseSteps { feature: base[0], scaling: base[1], offset: base[2] };
        let of_anchors: Vec<f32> = state.take_exactly("steps", 3 * anchors.len())?;
        positive("steps", &of_anchors)?;
        resumed.quantise(steps, steps.in_world(anchors.lattice.voxel), &of_anchors)?;
        if state.has("context") {
            resumed.modelling = Some(resumed.resume_model(anchors, state)?);
        }
        Ok(resumed)
    }

    fn resume_model(&self, anchors: &AnchorRows, state: &mut LearnerState) -> Result<Modelling, TrainError> {
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
        // Sizes of another model would make the device take what nobody asked for.
        if config.planes.edge > 256 || sizes.iter().any(|size| *size > 1024) {
            return Err(CheckpointError::array("context.sizes", "are no model's").into());
        }
        let centre: Vec<i32> = state.take_exactly("context.centre", 3)?;
        let half: Vec<u32> = state.take_exactly("context.half", 3)?;
        let frame =
            ContextFrame { centre: [centre[0], centre[1], centre[2]], half: [half[0], half[1], half[2]] };
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
        self.modelling_of(config, &model, frame, statistics, &anchors.cells)
    }
}
