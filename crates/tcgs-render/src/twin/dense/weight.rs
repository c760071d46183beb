//! The place of a weight among the parameters.

use crate::model::LayerSpec;

pub(super) fn weight(layer: &LayerSpec, output: usize, input: usize) -> usize {
    layer.weights + input * layer.outputs + output
}
