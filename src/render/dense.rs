//! Dense layers on the device, forward and backward, over the columns of a list.
//!
//! Activations are column-major: row r of a buffer holds one value for each of `capacity` columns; the list's first element is
//! the number of columns in use. Every sum has a fixed order, so the same input gives the same bits.

use std::sync::Arc;

use super::RenderError;
use crate::{
    gpu::{Binding, Buffer, Device, Kernel, Recorder, kernel_source},
    model::LayerSpec,
};

/// Columns that one partial sum of a weight gradient covers.
const GRADIENT_RUN: usize = 1024;

/// Outputs and columns that a workgroup of `shaders/dense.wgsl` computes.
const TILE: [usize; 2] = [32, 256];

/// Inputs and outputs of the weights whose gradients a workgroup of `shaders/dense_weight_gradient.wgsl` computes.
const GRADIENT_TILE: [usize; 2] = [16, 32];

/// Bias offset of a layer without a bias.
const NO_BIAS: u32 = u32::MAX;

/// Activation of a dense layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// None.
    Linear = 0,
    /// max(x, 0).
    Relu = 1,
}

/// The columns that layers are evaluated at.
#[derive(Debug, Clone, Copy)]
pub struct Columns<'a> {
    /// The number of columns in use, then what each stands for.
    pub list: &'a Buffer<u32>,
    /// Columns of the buffers.
    pub capacity: usize,
}

/// A layer evaluated at columns.
#[derive(Debug, Clone, Copy)]
pub struct DenseLayer<'a> {
    /// Its sizes and where its parameters and rows are.
    pub spec: &'a LayerSpec,
    /// The columns.
    pub columns: Columns<'a>,
}

impl<'a> Columns<'a> {
    /// `spec` at these columns.
    #[must_use]
    pub fn layer(self, spec: &'a LayerSpec) -> DenseLayer<'a> {
        DenseLayer { spec, columns: self }
    }
}

/// Where the gradient by a layer's inputs goes.
#[derive(Debug, Clone, Copy)]
pub struct InputGradient<'a> {
    /// The first inputs, whose gradients are wanted.
    pub rows: usize,
    /// Those inputs after a ReLU; the gradient is then the one before it.
    pub relu: Option<&'a Buffer<f32>>,
    /// The gradients.
    pub buffer: &'a Buffer<f32>,
}

/// The kernels of dense layers.
#[derive(Debug)]
pub struct DenseLayers {
    dense: Arc<Kernel>,
    dense_weight_gradient: Arc<Kernel>,
    sum_partials: Arc<Kernel>,
}

impl DenseLayers {
    /// Prepares the kernels; `subgroups` is the smallest number of lanes in a subgroup, where kernels may use them.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn new(device: &Device, subgroups: Option<u32>) -> Result<Self, RenderError> {
        // Eight lanes share their reads; the gradient's workgroup is one subgroup.
        let subgroups = subgroups.filter(|size| *size >= 8);
        let mut lanes = vec![("GRADIENT_LANES", subgroups.unwrap_or(64))];
        let mut dense = Vec::new();
        if let Some(size) = subgroups {
            lanes.push(("SUBGROUPS", size));
            dense.push(("SUBGROUPS", size));
        }
        Ok(Self {
            dense: device.kernel(kernel_source!("dense"), &dense)?,
            dense_weight_gradient: device.kernel(kernel_source!("dense_weight_gradient"), &lanes)?,
            sum_partials: device.kernel(kernel_source!("sum_partials"), &[])?,
        })
    }

    /// Partial sums of each weight's gradient over this many columns.
    #[must_use]
    pub fn runs(capacity: usize) -> usize {
        capacity.div_ceil(GRADIENT_RUN).max(1)
    }

    /// Records `output = layer(input)`.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn forward(
        &self,
        recorder: &mut Recorder<'_>,
        DenseLayer { spec: layer, columns }: DenseLayer<'_>,
        parameters: &Buffer<f32>,
        input: &Buffer<f32>,
        output: &Buffer<f32>,
        activation: Activation,
    ) -> Result<(), RenderError> {
        let uniform = recorder.uniform(&[
            [layer.inputs as u32, layer.outputs as u32, columns.capacity as u32, layer.weights as u32],
            [1, layer.outputs as u32, layer.bias as u32, activation as u32],
            [layer.input_row as u32, layer.output_row as u32, 0, 0],
        ])?;
        // The gate is not read; any buffer but the output is valid.
        let bindings: [Binding<'_>; 6] = [&uniform, columns.list, parameters, input, input, output];
        recorder.dispatch(&self.dense, &bindings, groups(columns, layer.outputs));
        Ok(())
    }

    /// Records the gradient by the layer's inputs.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn input_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        DenseLayer { spec: layer, columns }: DenseLayer<'_>,
        parameters: &Buffer<f32>,
        d_output: &Buffer<f32>,
        d_input: InputGradient<'_>,
    ) -> Result<(), RenderError> {
        const LINEAR: u32 = 0;
        const GATE: u32 = 2;
        let activation = if d_input.relu.is_some() { GATE } else { LINEAR };
        let uniform = recorder.uniform(&[
            [layer.outputs as u32, d_input.rows as u32, columns.capacity as u32, layer.weights as u32],
            [layer.outputs as u32, 1, NO_BIAS, activation],
            [layer.output_row as u32, layer.input_row as u32, layer.input_row as u32, 0],
        ])?;
        let bindings: [Binding<'_>; 6] =
            [&uniform, columns.list, parameters, d_output, d_input.relu.unwrap_or(d_output), d_input.buffer];
        recorder.dispatch(&self.dense, &bindings, groups(columns, d_input.rows));
        Ok(())
    }

    /// Records each run's partial gradients by the layer's weights and bias, `parameters` elements apart, for
    /// [`Self::sum_partials`].
    ///
    /// # Errors
    /// Faults of the device.
    pub fn weight_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        DenseLayer { spec: layer, columns }: DenseLayer<'_>,
        parameters: usize,
        input: &Buffer<f32>,
        d_output: &Buffer<f32>,
        partials: &Buffer<f32>,
    ) -> Result<(), RenderError> {
        let uniform = recorder.uniform(&[
            [layer.inputs as u32, layer.outputs as u32, columns.capacity as u32, layer.weights as u32],
            [1, layer.outputs as u32, layer.bias as u32, GRADIENT_RUN as u32],
            [layer.input_row as u32, layer.output_row as u32, parameters as u32, 0],
        ])?;
        let tiles = layer.inputs.div_ceil(GRADIENT_TILE[0]) * layer.outputs.div_ceil(GRADIENT_TILE[1]);
        let bindings: [Binding<'_>; 5] = [&uniform, columns.list, input, d_output, partials];
        recorder.dispatch(
            &self.dense_weight_gradient,
            &bindings,
            (tiles * Self::runs(columns.capacity)) as u32,
        );
        Ok(())
    }

    /// Records the first `parameters` elements of `sums` as the sums of the runs' partial gradients.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn sum_partials(
        &self,
        recorder: &mut Recorder<'_>,
        columns: Columns<'_>,
        parameters: usize,
        partials: &Buffer<f32>,
        sums: &Buffer<f32>,
    ) -> Result<(), RenderError> {
        let shape = recorder.uniform(&[[parameters as u32, GRADIENT_RUN as u32, 0, 0]])?;
        recorder.dispatch(
            &self.sum_partials,
            &[&shape, columns.list, partials, sums],
            parameters.div_ceil(64) as u32,
        );
        Ok(())
    }
}

fn groups(columns: Columns<'_>, outputs: usize) -> u32 {
    (outputs.div_ceil(TILE[0]) * columns.capacity.div_ceil(TILE[1])) as u32
}
