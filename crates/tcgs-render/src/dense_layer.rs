//! Dense layers as kernels take them: what they are evaluated at, from and into.
//!
//! Activations are column-major: row r of a buffer holds one value for each of `capacity` columns; the list's first element is
//! the number of columns in use.

use crate::{gpu::Buffer, model::LayerSpec};

/// Columns that one partial sum of a weight gradient covers.
pub(super) const GRADIENT_RUN: usize = 1024;

/// Bias offset of a layer without a bias.
pub(super) const NO_BIAS: u32 = u32::MAX;

/// Columns that kernels read at a time.
const COLUMNS_A_READ: usize = 4;

/// Activation of a dense layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// None.
    Linear = 0,
    /// max(x, 0).
    Relu = 1,
}

/// `MODE` of `shaders/dense/dense.wgsl` and `dense_software.wgsl` that applies the gate of a ReLU; the others are those of [`Activation`].
pub(crate) const GATE: u32 = 2;

/// The columns that layers are evaluated at.
#[derive(Debug, Clone, Copy)]
pub struct Columns<'a> {
    /// The number of columns in use, then what each stands for.
    pub list: &'a Buffer<u32>,
    /// Columns of the buffers, a multiple of four: see [`Columns::capacity_for`].
    pub capacity: usize,
}

/// A layer evaluated at columns.
#[derive(Debug, Clone, Copy)]
pub struct DenseLayer<'a> {
    /// Its sizes and where its parameters and rows are.
    pub spec: &'a LayerSpec,
    /// The columns.
    pub columns: Columns<'a>,
    /// Outputs that [`DenseLayers::forward`](super::DenseLayers::forward) computes, from the first on.
    pub outputs: usize,
}

impl DenseLayer<'_> {
    /// The same with only the first `outputs` outputs.
    #[must_use]
    pub fn first_outputs(self, outputs: usize) -> Self {
        Self { outputs: outputs.min(self.spec.outputs), ..self }
    }
}

impl<'a> Columns<'a> {
    /// Columns of buffers for `columns` of them: a quarter more, so that growth rarely reallocates, and a multiple of four, so that
    /// kernels can read four at a time.
    #[must_use]
    pub fn capacity_for(columns: usize) -> usize {
        (columns + columns / 4).next_multiple_of(COLUMNS_A_READ)
    }

    /// `spec` at these columns.
    #[must_use]
    pub fn layer(self, spec: &'a LayerSpec) -> DenseLayer<'a> {
        DenseLayer { spec, columns: self, outputs: spec.outputs }
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

/// Where the gradient by a layer's weights and bias goes.
#[derive(Debug, Clone, Copy)]
pub struct WeightGradient<'a> {
    /// Parameters of all layers.
    pub parameters: usize,
    /// Sums over runs of columns: [`DenseLayers::partials`](super::DenseLayers::partials) elements.
    pub partials: &'a Buffer<f32>,
    /// The gradients, complete once [`DenseLayers::finish_weight_gradients`](super::DenseLayers::finish_weight_gradients) was recorded.
    pub sums: &'a Buffer<f32>,
}
