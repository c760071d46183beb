//! The context model in training, on the device: the forward pass from a sample of anchors to the predicted distributions of
//! their attributes, and the backward pass from those to every parameter.

use std::sync::Arc;

use super::{
    ContextAnchors, ContextConfig, ContextLayout, ContextLearningRates, GroupStatistics,
    anchor_tables::DeviceTables,
    convolution::Tensor,
    plane_sampling::Sampling,
    planes::{PlanePass, PlaneSource},
    weights::RoundedWeights,
};
use crate::{
    gpu::{Buffer, Device, Plan, Recorder, planned},
    render::{Activation, Columns, DenseLayers, InputGradient, RenderError, WeightGradient},
    train::{Adam, AdamStep, ContextError, Moments, Result},
};

/// Marks an anchor that was not sampled.
const NO_COLUMN: u32 = u32::MAX;

/// The settings of a pass of the context model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContextPass {
    /// Which planes the networks sample.
    pub source: PlaneSource,
    /// Weight of the mean absolute difference of raw planes and their reconstruction (TC-GS (5), METHOD.md §4.6: 0.01); zero
    /// for none. Ignored once latents are parameters.
    pub reconstruction: f32,
    /// If weights are rounded as they will be stored, their largest integer in a network: 127, 31 or 7 for 8, 6 or 4 bits.
    /// Layers up always have 127.
    pub levels: Option<u8>,
    /// Whether planes, layers and latents learn; their gradients are zero if not.
    pub planes_learn: bool,
}

impl ContextPass {
    /// On raw planes, as in the first steps of the context model.
    pub const RAW: Self =
        Self { source: PlaneSource::Raw, reconstruction: 0.0, levels: None, planes_learn: true };

    fn reconstructs(&self, layout: &ContextLayout) -> bool {
        match self.source {
            PlaneSource::Raw => self.adds_reconstruction(layout),
            PlaneSource::Reconstructed => true,
            PlaneSource::Latents => false,
        }
    }

    /// Without layers the two are equal.
    fn adds_reconstruction(&self, layout: &ContextLayout) -> bool {
        self.reconstruction > 0.0
            && self.planes_learn
            && self.source != PlaneSource::Latents
            && !layout.up.is_empty()
    }
}

/// The trainable state, on the host.
#[derive(Debug, Clone, PartialEq)]
pub struct ContextState {
    /// The parameters.
    pub values: Vec<f32>,
    /// Their first moments.
    pub first: Vec<f32>,
    /// Their second moments.
    pub second: Vec<f32>,
}

impl ContextState {
    /// Parameters with zero moments.
    #[must_use]
    pub fn new(values: Vec<f32>) -> Self {
        let zeros = vec![0.0; values.len()];
        Self { first: zeros.clone(), second: zeros, values }
    }
}

/// Activations and their gradients, column-major with `capacity` columns.
#[derive(Debug)]
struct Activations {
    capacity: usize,
    list: Buffer<u32>,
    input: Buffer<f32>,
    hidden: Buffer<f32>,
    outputs: Buffer<f32>,
    d_input: Buffer<f32>,
    d_hidden: Buffer<f32>,
    d_outputs: Buffer<f32>,
    partials: Buffer<f32>,
}

impl Activations {
    fn plan(layout: &ContextLayout, capacity: usize) -> Plan<'static, Self> {
        let config = &layout.config;
        let rows = |label: &'static str, rows: usize| Plan::buffer(label, rows * capacity);
        let hidden = layout.hidden.outputs;
        let outputs = config.output_rows()[3];
        planned!(Self {
            capacity: Plan::value(capacity),
            list: Plan::buffer("sampled anchors", capacity + 1),
            input: rows("context input", config.inputs()),
            hidden: rows("context hidden values", hidden),
            outputs: rows("context outputs", outputs),
            d_input: rows("gradients of context input", config.sampled_inputs()),
            d_hidden: rows("gradients of context hidden values", hidden),
            d_outputs: rows("gradients of context outputs", outputs),
            partials: DenseLayers::partials(
                "partial context gradients",
                capacity,
                layout.network_layers(),
                layout.networks,
            ),
        })
    }

    fn columns(&self) -> Columns<'_> {
        Columns { list: &self.list, capacity: self.capacity }
    }
}

fn sample_gradients(config: &ContextConfig, anchors: usize) -> Plan<'static, Buffer<f32>> {
    let placed = if config.kind.sampled() > 0 { anchors } else { 0 };
    Plan::buffer("gradients of plane samples", 3 * config.planes.channels * placed)
}

fn parameter_gradients(layout: &ContextLayout) -> Plan<'static, Buffer<f32>> {
    Plan::buffer("gradients of context parameters", layout.parameters)
}

/// The context model in training. A pass leaves nothing behind but gradients; only [`ContextNet::step`] changes parameters.
#[derive(Debug)]
pub struct ContextNet {
    device: Arc<Device>,
    layout: ContextLayout,
    dense: DenseLayers,
    sampling: Sampling,
    planes: Option<PlanePass>,
    rounded: RoundedWeights,
    tables: DeviceTables,
    on: Activations,
    /// `[N][3 channels]`: gradients by the samples at each anchor.
    d_samples: Buffer<f32>,
    parameters: Buffer<f32>,
    gradients: Buffer<f32>,
    moments: Moments,
    last: Option<ContextPass>,
}

impl ContextNet {
    /// A model with the parameters of `state`; [`Self::place`] then sets the anchors.
    ///
    /// # Errors
    /// [`ContextError`] for unsupported sizes or a state of another length; errors of the device.
    pub fn new(device: &Arc<Device>, config: ContextConfig, state: &ContextState) -> Result<Self> {
        let layout = ContextLayout::new(config)?;
        for values in [&state.values, &state.first, &state.second] {
            if values.len() != layout.parameters {
                let (found, expected) = (values.len(), layout.parameters);
                return Err(ContextError::Parameters { found, expected }.into());
            }
        }
        let planes =
            (config.kind.sampled() > 0).then(|| PlanePass::plan(&layout).make(device)).transpose()?;
        Ok(Self {
            dense: DenseLayers::new(device, device.subgroups().lanes(), layout.network_layers())?,
            sampling: Sampling::new(device)?,
            planes,
            rounded: RoundedWeights::plan(&layout).make(device)?,
            tables: DeviceTables::upload(device, &config, &ContextAnchors::default())?,
            on: Activations::plan(&layout, 0).make(device)?,
            d_samples: sample_gradients(&layout.config, 0).make(device)?,
            parameters: device.upload("context parameters", &state.values)?,
            gradients: parameter_gradients(&layout).make(device)?,
            moments: Moments::upload(device, &state.first, &state.second)?,
            last: None,
            layout,
            device: Arc::clone(device),
        })
    }

    /// Columns of the buffers for samples of `sample` anchors: see [`Columns::capacity_for`].
    #[must_use]
    pub fn capacity(sample: usize) -> usize {
        Columns::capacity_for(sample)
    }

    /// Bytes on the device for `anchors` anchors and samples of `sample` of them, once a step was made.
    ///
    /// # Errors
    /// [`ContextError::Config`] for unsupported sizes.
    pub fn bytes(config: &ContextConfig, anchors: usize, sample: usize) -> Result<u64, ContextError> {
        let layout = ContextLayout::new(*config)?;
        let planes = if config.kind.sampled() > 0 { PlanePass::plan(&layout).bytes() } else { 0 };
        Ok(DeviceTables::max_bytes(config, anchors)
            + Activations::plan(&layout, Self::capacity(sample)).bytes()
            + sample_gradients(config, anchors).bytes()
            // The parameters take as much as their gradients.
            + 2 * parameter_gradients(&layout).bytes()
            + RoundedWeights::plan(&layout).bytes()
            + DenseLayers::bytes(layout.network_layers())
            + Moments::plan(layout.parameters).bytes()
            + planes)
    }

    /// The layout of the parameters.
    #[must_use]
    pub fn layout(&self) -> &ContextLayout {
        &self.layout
    }

    /// Sets the anchors; call it whenever they change.
    ///
    /// # Errors
    /// [`ContextError::Anchors`] for tables that do not fit the model; errors of the device.
    pub fn place(&mut self, anchors: &ContextAnchors) -> Result<()> {
        let config = &self.layout.config;
        anchors.check(config)?;
        self.last = None;
        self.tables = DeviceTables::upload(&self.device, config, anchors)?;
        self.d_samples = sample_gradients(config, anchors.count).make(&self.device)?;
        Ok(())
    }

    /// Records the networks' outputs for a sample of anchors: distinct indices, in the order of their columns.
    ///
    /// # Errors
    /// [`ContextError::Anchors`] for an index out of range or one given twice; errors of the device.
    pub fn forward(&mut self, recorder: &mut Recorder<'_>, sample: &[u32], pass: &ContextPass) -> Result<()> {
        self.write_sample(recorder, sample)?;
        let Self { layout, planes, rounded, on, .. } = self;
        if let Some(levels) = pass.levels {
            rounded.record(recorder, &self.parameters, levels)?;
        }
        let stored = if pass.levels.is_some() { rounded.values() } else { &self.parameters };
        // Without planes these bindings are not read; any buffer is valid.
        let mut sampled = Tensor::at(&self.parameters, 0);
        if let Some(planes) = planes {
            if pass.reconstructs(layout) {
                let latents = planes.down(recorder, layout, &self.parameters)?;
                planes.up(recorder, layout, stored, &latents)?;
            }
            if pass.source == PlaneSource::Latents {
                let latents = Tensor::at(&self.parameters, layout.latents.start);
                planes.up(recorder, layout, stored, &latents)?;
            }
            sampled = planes.planes(pass.source, layout, &self.parameters);
        }
        let columns = on.columns();
        self.sampling.forward(recorder, &self.tables, columns, &sampled, &on.input)?;
        self.dense.load(recorder, stored);
        let hidden = columns.layer(&layout.hidden);
        self.dense.forward(recorder, hidden, stored, &on.input, &on.hidden, Activation::Relu)?;
        for head in &layout.heads {
            let head = columns.layer(head);
            self.dense.forward(recorder, head, stored, &on.hidden, &on.outputs, Activation::Linear)?;
        }
        self.last = Some(*pass);
        Ok(())
    }

    /// Records the gradients by all parameters from those by the outputs of the last forward pass. Parameters must not have
    /// changed since.
    ///
    /// # Errors
    /// [`RenderError::OutOfStep`] before a forward pass; errors of the device.
    pub fn backward(&mut self, recorder: &mut Recorder<'_>) -> Result<()> {
        let pass = self.last.ok_or(RenderError::OutOfStep)?;
        recorder.clear(&self.gradients);
        let stored = if pass.levels.is_some() { self.rounded.values() } else { &self.parameters };
        self.network_gradients(recorder, stored)?;
        if pass.planes_learn
            && let Some(planes) = &self.planes
        {
            self.plane_gradients(recorder, stored, planes, &pass)?;
        }
        Ok(())
    }

    fn network_gradients(
        &self,
        recorder: &mut Recorder<'_>,
        stored: &Buffer<f32>,
    ) -> Result<(), RenderError> {
        let Self { layout, dense, on, .. } = self;
        let columns = on.columns();
        let by_weights =
            WeightGradient { parameters: layout.networks, partials: &on.partials, sums: &self.gradients };
        for head in &layout.heads {
            let layer = columns.layer(head);
            dense.weight_gradient(recorder, layer, &on.hidden, &on.d_outputs, by_weights)?;
            let d_hidden = InputGradient { rows: head.inputs, relu: Some(&on.hidden), buffer: &on.d_hidden };
            dense.input_gradient(recorder, layer, stored, &on.d_outputs, d_hidden)?;
        }
        let hidden = columns.layer(&layout.hidden);
        dense.weight_gradient(recorder, hidden, &on.input, &on.d_hidden, by_weights)?;
        dense.finish_weight_gradients(recorder, columns, by_weights)
    }

    fn plane_gradients(
        &self,
        recorder: &mut Recorder<'_>,
        stored: &Buffer<f32>,
        planes: &PlanePass,
        pass: &ContextPass,
    ) -> Result<()> {
        let Self { layout, on, parameters, gradients, .. } = self;
        let hidden = on.columns().layer(&layout.hidden);
        let d_input = InputGradient { rows: layout.config.sampled_inputs(), relu: None, buffer: &on.d_input };
        self.dense.input_gradient(recorder, hidden, stored, &on.d_hidden, d_input)?;
        self.sampling.backward(
            recorder,
            &self.tables,
            on.capacity,
            &on.d_input,
            &self.d_samples,
            &planes.plane_gradients(pass.source, layout, gradients),
        )?;
        if pass.adds_reconstruction(layout) {
            if pass.source == PlaneSource::Raw {
                planes.clear_gradients(recorder);
            }
            planes.reconstruction_gradient(recorder, layout, pass.reconstruction, parameters, gradients)?;
        }
        if layout.up.is_empty() {
            return Ok(());
        }
        if pass.source == PlaneSource::Latents {
            let d_latents = Tensor::at(gradients, layout.latents.start);
            planes.up_gradient(recorder, layout, stored, gradients, &d_latents)?;
        } else if pass.reconstructs(layout) {
            planes.up_gradient(recorder, layout, stored, gradients, planes.latent_gradients())?;
            planes.down_gradient(recorder, layout, parameters, gradients)?;
        }
        Ok(())
    }

    /// Records an optimizer step with the last gradients.
    ///
    /// # Errors
    /// [`ContextError::Config`] if the statistics have another number of channels; errors of the device.
    pub fn step(
        &self,
        recorder: &mut Recorder<'_>,
        adam: &Adam,
        step: AdamStep<'_>,
        learning_rates: &ContextLearningRates,
        statistics: &[GroupStatistics; 3],
    ) -> Result<()> {
        let learning_rates = recorder.uniform(&self.layout.learning_rates(learning_rates, statistics)?)?;
        adam.step(recorder, step, &learning_rates, &self.gradients, &self.parameters, &self.moments)?;
        Ok(())
    }

    /// Records setting the latents from the raw planes. From here on latents are parameters of their own.
    pub fn latents_from_planes(&self, recorder: &mut Recorder<'_>) -> Result<()> {
        if let Some(planes) = &self.planes {
            let latents = planes.down(recorder, &self.layout, &self.parameters)?;
            let (from, to) = (latents.first, &self.layout.latents);
            if self.layout.down.is_empty() {
                // A buffer cannot be copied onto itself; this one is overwritten later in any case.
                let by = self.rounded.values();
                recorder.copy(&latents.buffer, from, by, 0, to.len());
                recorder.copy(by, 0, &self.parameters, to.start, to.len());
            } else {
                recorder.copy(&latents.buffer, from, &self.parameters, to.start, to.len());
            }
        }
        Ok(())
    }

    /// The last forward pass's number of anchors, then their indices.
    #[must_use]
    pub fn sample(&self) -> &Buffer<u32> {
        &self.on.list
    }

    /// Columns of a row of the outputs.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.on.capacity
    }

    /// The networks' outputs, column-major; each group's begin at its row of [`ContextConfig::output_rows`].
    #[must_use]
    pub fn outputs(&self) -> &Buffer<f32> {
        &self.on.outputs
    }

    /// Buffer for a loss's gradients by the outputs; every value of a sampled column must be written.
    #[must_use]
    pub fn output_gradients(&self) -> &Buffer<f32> {
        &self.on.d_outputs
    }

    /// The parameters.
    #[must_use]
    pub fn parameters(&self) -> &Buffer<f32> {
        &self.parameters
    }

    /// The parameters as the last forward pass used them, rounded if it was asked to.
    #[must_use]
    pub fn stored(&self) -> &Buffer<f32> {
        if self.last.is_some_and(|pass| pass.levels.is_some()) {
            self.rounded.values()
        } else {
            &self.parameters
        }
    }

    /// The gradients of the last backward pass.
    #[must_use]
    pub fn gradients(&self) -> &Buffer<f32> {
        &self.gradients
    }

    /// Reads back the trainable state. Waits for the device.
    pub fn save(&self) -> Result<ContextState> {
        Ok(ContextState {
            values: self.device.read(&self.parameters)?,
            first: self.device.read(&self.moments.first)?,
            second: self.device.read(&self.moments.second)?,
        })
    }

    fn write_sample(&mut self, recorder: &mut Recorder<'_>, sample: &[u32]) -> Result<()> {
        let mut columns = vec![NO_COLUMN; self.tables.count];
        for (anchor, column) in sample.iter().zip(0..) {
            match columns.get_mut(*anchor as usize) {
                Some(place) if *place == NO_COLUMN => *place = column,
                _ => {
                    let count = self.tables.count;
                    let error = format!("anchor {anchor} is sampled twice or is none of {count}");
                    return Err(ContextError::Anchors(error).into());
                }
            }
        }
        if sample.len() > self.on.capacity {
            self.last = None;
            self.on = Activations::plan(&self.layout, Self::capacity(sample.len())).make(&self.device)?;
        }
        let mut list = Vec::with_capacity(sample.len() + 1);
        list.push(sample.len() as u32);
        list.extend_from_slice(sample);
        recorder.write(&self.on.list, &list);
        if self.planes.is_some() {
            recorder.write(&self.tables.columns, &columns);
        }
        Ok(())
    }
}
