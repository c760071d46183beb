//! Dense layers on the device, forward and backward, over the columns of a list.
//!
//! Every sum has a fixed order, so the same input gives the same bits.

use std::sync::Arc;

use super::{
    Result,
    dense_layer::{
        Activation, Columns, DenseLayer, GATE, GRADIENT_RUN, InputGradient, NO_BIAS, WeightGradient,
    },
    dense_software::{MIN_LANES, SoftwareLayers},
};
use crate::{
    gpu::{Binding, Buffer, Device, Kernel, KernelVariant, Plan, Recorder, kernel_source},
    model::LayerSpec,
};

/// Outputs and columns that a workgroup of `shaders/dense/dense.wgsl` computes.
const TILE: [usize; 2] = [8, 64];

/// As in `shaders/shared/runs.wgsl`.
const RUNS: usize = 128;
const MIN_RUN: usize = 128;

/// Inputs and outputs of the weights whose gradients a workgroup of `shaders/dense/dense_weight_gradient.wgsl` computes.
const GRADIENT_TILE: [usize; 2] = [16, 32];

/// The kernels of dense layers: one set for hardware, one for software adapters that have subgroups.
#[derive(Debug)]
pub struct DenseLayers {
    kernels: Kernels,
}

#[derive(Debug)]
enum Kernels {
    Hardware(HardwareLayers),
    Software(SoftwareLayers),
}

#[derive(Debug)]
struct HardwareLayers {
    /// By mode.
    dense: [Arc<Kernel>; 3],
    dense_weight_gradient: Arc<Kernel>,
    sum_partials: Arc<Kernel>,
}

impl DenseLayers {
    /// Prepares the kernels for `layers`; `subgroups` is the smallest number of lanes in a subgroup, where kernels may use them.
    pub fn new(
        device: &Device,
        subgroups: Option<u32>,
        layers: impl IntoIterator<Item = LayerSpec>,
    ) -> Result<Self> {
        let shares = subgroups.is_some_and(|lanes| lanes >= MIN_LANES);
        Ok(Self {
            kernels: if shares && device.variant() == KernelVariant::Software {
                Kernels::Software(SoftwareLayers::plan(layers).make(device)?)
            } else {
                Kernels::Hardware(HardwareLayers::new(device, subgroups)?)
            },
        })
    }

    /// Bytes on the device of what [`DenseLayers::new`] makes at most.
    #[must_use]
    pub fn bytes(layers: impl IntoIterator<Item = LayerSpec>) -> u64 {
        SoftwareLayers::plan(layers).bytes()
    }

    /// Plans the partial sums of the gradients by the weights of `layers`, of `parameters` parameters in all.
    #[must_use]
    pub fn partials(
        label: &'static str,
        capacity: usize,
        layers: impl IntoIterator<Item = LayerSpec>,
        parameters: usize,
    ) -> Plan<'static, Buffer<f32>> {
        let software = layers.into_iter().map(|layer| SoftwareLayers::partials(&layer)).sum::<usize>();
        let partials = software * capacity.div_ceil(GRADIENT_RUN).max(1);
        Plan::buffer(label, partials.max(parameters * max_runs(capacity)))
    }

    /// Records reading the parameters of all layers. Layers are evaluated and differentiated with them until the next call.
    pub fn load(&self, recorder: &mut Recorder<'_>, parameters: &Buffer<f32>) {
        if let Kernels::Software(kernels) = &self.kernels {
            kernels.load(recorder, parameters);
        }
    }

    /// Records `output = layer(input)`; [`Self::load`] has read the same parameters.
    pub fn forward(
        &self,
        recorder: &mut Recorder<'_>,
        layer: DenseLayer<'_>,
        parameters: &Buffer<f32>,
        input: &Buffer<f32>,
        output: &Buffer<f32>,
        activation: Activation,
    ) -> Result<()> {
        match &self.kernels {
            Kernels::Hardware(kernels) => {
                kernels.forward(recorder, layer, parameters, input, output, activation)
            }
            Kernels::Software(kernels) => {
                kernels.forward(recorder, layer, parameters, input, output, activation)
            }
        }
    }

    /// Records the gradient by the layer's inputs.
    pub fn input_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        layer: DenseLayer<'_>,
        parameters: &Buffer<f32>,
        d_output: &Buffer<f32>,
        d_input: InputGradient<'_>,
    ) -> Result<()> {
        match &self.kernels {
            Kernels::Hardware(kernels) => {
                kernels.input_gradient(recorder, layer, parameters, d_output, d_input)
            }
            Kernels::Software(kernels) => {
                kernels.input_gradient(recorder, layer, parameters, d_output, d_input)
            }
        }
    }

    /// Records the gradient by the layer's weights and bias; [`Self::finish_weight_gradients`] follows that of the last layer.
    pub fn weight_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        layer: DenseLayer<'_>,
        input: &Buffer<f32>,
        d_output: &Buffer<f32>,
        out: WeightGradient<'_>,
    ) -> Result<()> {
        match &self.kernels {
            Kernels::Hardware(kernels) => kernels.weight_gradient(recorder, layer, input, d_output, out),
            Kernels::Software(kernels) => kernels.weight_gradient(recorder, layer, input, d_output, out),
        }
    }

    /// Completes the gradients by the weights of all layers.
    pub fn finish_weight_gradients(
        &self,
        recorder: &mut Recorder<'_>,
        columns: Columns<'_>,
        out: WeightGradient<'_>,
    ) -> Result<()> {
        match &self.kernels {
            Kernels::Hardware(kernels) => kernels.sum_partials(recorder, columns, out),
            Kernels::Software(kernels) => {
                kernels.sum_weight_gradients(recorder, columns, out);
                Ok(())
            }
        }
    }
}

impl HardwareLayers {
    fn new(device: &Device, subgroups: Option<u32>) -> Result<Self> {
        // Eight lanes share their reads; the gradient's workgroup is one subgroup.
        let subgroups = subgroups.filter(|size| *size >= MIN_LANES);
        let mut lanes = vec![("GRADIENT_LANES", subgroups.unwrap_or(64))];
        lanes.extend(subgroups.map(|size| ("SUBGROUPS", size)));
        let dense = |mode| device.kernel(kernel_source!("dense"), &[("MODE", mode)]);
        Ok(Self {
            dense: [dense(Activation::Linear as u32)?, dense(Activation::Relu as u32)?, dense(GATE)?],
            dense_weight_gradient: device.kernel(kernel_source!("dense_weight_gradient"), &lanes)?,
            sum_partials: device.kernel(kernel_source!("sum_partials"), &[])?,
        })
    }

    fn forward(
        &self,
        recorder: &mut Recorder<'_>,
        DenseLayer { spec: layer, columns, outputs }: DenseLayer<'_>,
        parameters: &Buffer<f32>,
        input: &Buffer<f32>,
        output: &Buffer<f32>,
        activation: Activation,
    ) -> Result<()> {
        let uniform = recorder.uniform(&[
            [layer.inputs as u32, outputs as u32, columns.capacity as u32, layer.weights as u32],
            [1, layer.outputs as u32, layer.bias as u32, 0],
            [layer.input_row as u32, layer.output_row as u32, 0, 0],
        ])?;
        let bindings: [Binding<'_>; 5] = [&uniform, columns.list, parameters, input, output];
        recorder.dispatch(&self.dense[activation as usize], &bindings, groups(columns, outputs));
        Ok(())
    }

    fn input_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        DenseLayer { spec: layer, columns, .. }: DenseLayer<'_>,
        parameters: &Buffer<f32>,
        d_output: &Buffer<f32>,
        d_input: InputGradient<'_>,
    ) -> Result<()> {
        let uniform = recorder.uniform(&[
            [layer.outputs as u32, d_input.rows as u32, columns.capacity as u32, layer.weights as u32],
            [layer.outputs as u32, 1, NO_BIAS, 0],
            [layer.output_row as u32, layer.input_row as u32, layer.input_row as u32, 0],
        ])?;
        let (mode, bound) = if d_input.relu.is_some() { (GATE, 6) } else { (Activation::Linear as u32, 5) };
        let gate = d_input.relu.unwrap_or(d_output);
        let bindings: [Binding<'_>; 6] = [&uniform, columns.list, parameters, d_output, d_input.buffer, gate];
        recorder.dispatch(&self.dense[mode as usize], &bindings[..bound], groups(columns, d_input.rows));
        Ok(())
    }

    fn weight_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        DenseLayer { spec: layer, columns, .. }: DenseLayer<'_>,
        input: &Buffer<f32>,
        d_output: &Buffer<f32>,
        out: WeightGradient<'_>,
    ) -> Result<()> {
        let uniform = recorder.uniform(&[
            [layer.inputs as u32, layer.outputs as u32, columns.capacity as u32, layer.weights as u32],
            [1, layer.outputs as u32, layer.bias as u32, 0],
            [layer.input_row as u32, layer.output_row as u32, out.parameters as u32, 0],
        ])?;
        let tiles = layer.inputs.div_ceil(GRADIENT_TILE[0]) * layer.outputs.div_ceil(GRADIENT_TILE[1]);
        let runs = max_runs(columns.capacity);
        let bindings: [Binding<'_>; 5] = [&uniform, columns.list, input, d_output, out.partials];
        recorder.dispatch(&self.dense_weight_gradient, &bindings, (tiles * runs) as u32);
        Ok(())
    }

    fn sum_partials(
        &self,
        recorder: &mut Recorder<'_>,
        columns: Columns<'_>,
        WeightGradient { parameters, partials, sums }: WeightGradient<'_>,
    ) -> Result<()> {
        let shape = recorder.uniform(&[[parameters as u32, 0, 0, 0]])?;
        recorder.dispatch(
            &self.sum_partials,
            &[&shape, columns.list, partials, sums],
            parameters.div_ceil(64) as u32,
        );
        Ok(())
    }
}

/// Most runs of up to `capacity` columns.
fn max_runs(capacity: usize) -> usize {
    capacity.div_ceil(MIN_RUN).clamp(1, RUNS)
}

fn groups(columns: Columns<'_>, outputs: usize) -> u32 {
    (outputs.div_ceil(TILE[0]) * columns.capacity.div_ceil(TILE[1])) as u32
}
