//! The kernels of dense layers for software adapters, which a CPU runs several times as fast as those for hardware.
//!
//! What always holds: buffers have rows of a multiple of four columns. The weights of all layers are packed in one dispatch, and
//! their partial gradients summed in one: on a small sample a dispatch costs more than what it computes.

use std::sync::Arc;

use super::{
    RenderError, Result,
    dense_layer::{
        Activation, Columns, DenseLayer, GATE, GRADIENT_RUN, InputGradient, NO_BIAS, WeightGradient,
    },
};
use crate::{
    gpu::{Buffer, Kernel, Plan, Recorder, kernel_source, planned},
    model::LayerSpec,
};

/// Lanes of a subgroup that share what they read.
pub(super) const MIN_LANES: u32 = 8;

/// Most blocks of four inputs that an invocation of `shaders/dense/dense_software.wgsl` holds.
const MAX_BLOCKS: usize = 24;

/// Columns that a workgroup of that kernel computes.
const COLUMNS: usize = 32;

/// Columns that an invocation of `shaders/dense/dense_weight_gradient_software.wgsl` holds, and outputs of a workgroup.
const GRADIENT_BLOCK: u32 = 64;
const GRADIENT_OUTPUTS: usize = 32;

/// What is computed from what: a layer, or its transpose.
#[derive(Debug, Clone, Copy)]
struct Product {
    inputs: usize,
    outputs: usize,
    /// First weight, and the distance of weights from one output to the next and from one input to the next.
    weights: usize,
    strides: [usize; 2],
    bias: u32,
    input_row: usize,
    output_row: usize,
    mode: u32,
}

impl Product {
    /// Blocks of four inputs that are held at a time: as few turns as [`MAX_BLOCKS`] allows, of equal size.
    fn blocks(&self) -> usize {
        let blocks = self.inputs.div_ceil(4);
        blocks.div_ceil(self.turns())
    }

    fn turns(&self) -> usize {
        self.inputs.div_ceil(4 * MAX_BLOCKS).max(1)
    }

    /// Vectors of four weights of an output; those of the last turn are read eight at a time.
    fn packing(&self) -> usize {
        (self.turns() - 1) * self.blocks() + self.blocks().next_multiple_of(8)
    }

    fn transposed(layer: &LayerSpec, rows: usize, mode: u32) -> Self {
        Self {
            inputs: layer.outputs,
            outputs: rows,
            weights: layer.weights,
            strides: [layer.outputs, 1],
            bias: NO_BIAS,
            input_row: layer.output_row,
            output_row: layer.input_row,
            mode,
        }
    }

    fn of(layer: &LayerSpec, mode: u32) -> Self {
        Self {
            inputs: layer.inputs,
            outputs: layer.outputs,
            weights: layer.weights,
            strides: [1, layer.outputs],
            bias: layer.bias as u32,
            input_row: layer.input_row,
            output_row: layer.output_row,
            mode,
        }
    }
}

/// Where a layer's packed weights and its partial gradients are, in vectors of four.
#[derive(Debug, Clone, Copy)]
struct Places {
    layer: LayerSpec,
    forward: usize,
    transposed: usize,
    sums: usize,
}

/// The layers in order, and the tables that kernels read.
#[derive(Debug, Default)]
struct PackedLayout {
    places: Vec<Places>,
    products: Vec<[u32; 8]>,
    packed: usize,
    sums: Vec<[u32; 8]>,
    sum_vectors: usize,
}

impl PackedLayout {
    fn new(layers: impl IntoIterator<Item = LayerSpec>) -> Self {
        let mut layout = Self::default();
        for layer in layers {
            let forward = layout.pack(&Product::of(&layer, 0));
            let transposed = layout.pack(&Product::transposed(&layer, layer.inputs, 0));
            let sums = layout.sum_vectors;
            layout.sum_vectors += SoftwareLayers::partials(&layer) / 4;
            let [inputs, outputs] = [layer.inputs as u32, layer.outputs as u32];
            let [weights, bias] = [layer.weights as u32, layer.bias as u32];
            let end = layout.sum_vectors as u32;
            layout.sums.push([inputs, outputs, GRADIENT_RUN as u32, end, weights, bias, 0, 0]);
            layout.places.push(Places { layer, forward, transposed, sums });
        }
        let all = layout.sum_vectors as u32;
        layout.sums.iter_mut().for_each(|layer| layer[6] = all);
        layout
    }

    /// The first vector of the product's packed weights.
    fn pack(&mut self, product: &Product) -> usize {
        let first = self.packed;
        self.packed += product.outputs * product.packing();
        let [inputs, outputs] = [product.inputs as u32, product.outputs as u32];
        let [by_output, by_input] = product.strides.map(|stride| stride as u32);
        let (weights, packing) = (product.weights as u32, product.packing() as u32);
        let end = self.packed as u32;
        self.products.push([inputs, outputs, weights, packing, by_output, by_input, end, 0]);
        first
    }

    fn places(&self, layer: &LayerSpec) -> Result<Places> {
        self.places.iter().find(|places| places.layer == *layer).copied().ok_or(RenderError::OutOfStep)
    }
}

#[derive(Debug)]
pub(super) struct SoftwareLayers {
    pack_weights: Arc<Kernel>,
    dense_weight_gradient: Arc<Kernel>,
    sum_weight_gradient: Arc<Kernel>,
    layout: PackedLayout,
    products: Buffer<[u32; 8]>,
    sums: Buffer<[u32; 8]>,
    packed: Buffer<[f32; 4]>,
}

impl SoftwareLayers {
    pub(super) fn plan(layers: impl IntoIterator<Item = LayerSpec>) -> Plan<'static, Self> {
        let layout = PackedLayout::new(layers);
        planned!(Self {
            pack_weights: Plan::kernel(kernel_source!("pack_weights"), &[]),
            dense_weight_gradient: Plan::kernel(kernel_source!("dense_weight_gradient_software"), &[]),
            sum_weight_gradient: Plan::kernel(kernel_source!("sum_weight_gradient"), &[]),
            products: Plan::upload("products of layers", layout.products.clone()),
            sums: Plan::upload("sums of layers", layout.sums.clone()),
            packed: Plan::buffer("packed weights", layout.packed),
            layout: Plan::value(layout),
        })
    }

    /// Floats of the partial gradients of a layer over one run.
    pub(super) fn partials(layer: &LayerSpec) -> usize {
        (layer.inputs + 1) * layer.outputs.next_multiple_of(4)
    }

    pub(super) fn load(&self, recorder: &mut Recorder<'_>, parameters: &Buffer<f32>) {
        recorder.dispatch(
            &self.pack_weights,
            &[&self.products, parameters, &self.packed],
            self.layout.packed.div_ceil(64) as u32,
        );
    }

    pub(super) fn forward(
        &self,
        recorder: &mut Recorder<'_>,
        layer: DenseLayer<'_>,
        parameters: &Buffer<f32>,
        input: &Buffer<f32>,
        output: &Buffer<f32>,
        activation: Activation,
    ) -> Result<()> {
        let first = self.layout.places(layer.spec)?.forward;
        let product = Product { outputs: layer.outputs, ..Product::of(layer.spec, activation as u32) };
        self.record(recorder, layer, (product, first), [input, parameters, output])
    }

    pub(super) fn input_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        layer: DenseLayer<'_>,
        parameters: &Buffer<f32>,
        d_output: &Buffer<f32>,
        d_input: InputGradient<'_>,
    ) -> Result<()> {
        let mode = if d_input.relu.is_some() { GATE } else { Activation::Linear as u32 };
        let first = self.layout.places(layer.spec)?.transposed;
        let product = Product::transposed(layer.spec, d_input.rows, mode);
        let gate = d_input.relu.unwrap_or(parameters);
        self.record(recorder, layer, (product, first), [d_output, gate, d_input.buffer])
    }

    /// Records a product of the source, whose packed weights begin at `first`, with biases or a gate, into the results.
    fn record(
        &self,
        recorder: &mut Recorder<'_>,
        DenseLayer { columns, .. }: DenseLayer<'_>,
        (product, first): (Product, usize),
        [source, bias_or_gate, results]: [&Buffer<f32>; 3],
    ) -> Result<()> {
        let (inputs, outputs) = (product.inputs as u32, product.outputs as u32);
        let (blocks, packing) = (product.blocks() as u32, product.packing() as u32);
        let layer = recorder.uniform(&[
            [inputs, outputs, (columns.capacity / 4) as u32, 4 * blocks],
            [product.input_row as u32, product.output_row as u32, product.output_row as u32, product.bias],
            [packing, first as u32, 0, 0],
        ])?;
        let defs = [("BLOCKS", blocks), ("MODE", product.mode)];
        let kernel = recorder.kernel(kernel_source!("dense_software"), &defs)?;
        recorder.dispatch(
            &kernel,
            &[&layer, columns.list, &self.packed, source, bias_or_gate, results],
            columns.capacity.div_ceil(COLUMNS) as u32,
        );
        Ok(())
    }

    pub(super) fn weight_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        DenseLayer { spec: layer, columns, .. }: DenseLayer<'_>,
        input: &Buffer<f32>,
        d_output: &Buffer<f32>,
        out: WeightGradient<'_>,
    ) -> Result<()> {
        let [inputs, outputs] = [layer.inputs as u32, layer.outputs as u32];
        let first = self.layout.places(layer)?.sums as u32;
        let uniform = recorder.uniform(&[
            [inputs, outputs, (columns.capacity / 4) as u32, GRADIENT_RUN as u32],
            [layer.input_row as u32, layer.output_row as u32, GRADIENT_BLOCK, 0],
            [first, self.layout.sum_vectors as u32, 0, 0],
        ])?;
        let tiles = layer.outputs.div_ceil(GRADIENT_OUTPUTS);
        let runs = columns.capacity.div_ceil(GRADIENT_RUN);
        recorder.dispatch(
            &self.dense_weight_gradient,
            &[&uniform, columns.list, input, d_output, out.partials],
            (tiles * runs) as u32,
        );
        Ok(())
    }

    pub(super) fn sum_weight_gradients(
        &self,
        recorder: &mut Recorder<'_>,
        columns: Columns<'_>,
        out: WeightGradient<'_>,
    ) {
        recorder.dispatch(
            &self.sum_weight_gradient,
            &[&self.sums, columns.list, out.partials, out.sums],
            self.layout.sum_vectors.div_ceil(64) as u32,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inputs_are_held_in_as_few_turns_as_allowed_and_of_equal_size() {
        let of = |inputs: usize| {
            let layer = LayerSpec { inputs, outputs: 1, weights: 0, bias: 0, input_row: 0, output_row: 0 };
            let product = Product::of(&layer, 0);
            (product.blocks(), product.turns(), product.packing())
        };
        assert_eq!(of(1), (1, 1, 8));
        assert_eq!(of(36), (9, 1, 16));
        assert_eq!(of(96), (24, 1, 24));
        assert_eq!(of(97), (13, 2, 29));
        assert_eq!(of(150), (19, 2, 43));
        for inputs in 1..500 {
            let (blocks, turns, _) = of(inputs);
            assert!(blocks <= MAX_BLOCKS && 4 * blocks * turns >= inputs, "{inputs}");
        }
    }
}
