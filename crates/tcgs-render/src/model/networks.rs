//! The three render networks in one flat array of parameters.
//!
//! They share their input, so their first layers are one layer of three times as many outputs as a network has hidden values (opacity, covariance, color in this
//! order); each output layer reads its own third of the hidden values. Weights are input-major: the weight of
//! (output o, input i) is at `weights + i * outputs + o`.

use rand::{Rng, RngExt};

use super::ModelShape;
use crate::domain::{DenseLayer, Mlp, RenderNetworks};

/// One dense layer in the flat array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LayerSpec {
    /// Input width.
    pub inputs: usize,
    /// Output width.
    pub outputs: usize,
    /// Index of its first weight.
    pub weights: usize,
    /// Index of its first bias.
    pub bias: usize,
    /// First row of its input in the activations that it reads.
    pub input_row: usize,
    /// First row of its output in the activations that it writes.
    pub output_row: usize,
}

impl LayerSpec {
    /// The outputs from `first` on, `outputs` of them, as a layer of the domain's; `values` are the flat parameters.
    #[must_use]
    pub fn part(&self, values: &[f32], first: usize, outputs: usize) -> DenseLayer {
        DenseLayer {
            inputs: self.inputs,
            outputs,
            weights: (first..first + outputs)
                .flat_map(|output| {
                    (0..self.inputs).map(move |input| self.weights + input * self.outputs + output)
                })
                .map(|index| values[index])
                .collect(),
            bias: values[self.bias + first..][..outputs].to_vec(),
        }
    }
}

/// The layout of the flat array of parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NetworkLayout {
    /// Widths of the model.
    pub shape: ModelShape,
    /// The three first layers as one.
    pub hidden: LayerSpec,
    /// Output layers: opacity, covariance, color.
    pub heads: [LayerSpec; 3],
    /// Parameters in all.
    pub parameters: usize,
}

impl NetworkLayout {
    /// The layout for a shape.
    #[must_use]
    pub fn new(shape: ModelShape) -> Self {
        let width = shape.hidden;
        let mut next = 0;
        let mut layer = |inputs: usize, outputs: usize, input_row: usize, output_row: usize| {
            let weights = next;
            let bias = weights + inputs * outputs;
            next = bias + outputs;
            LayerSpec { inputs, outputs, weights, bias, input_row, output_row }
        };
        let hidden = layer(shape.features + shape.view_degree.inputs(), 3 * width, 0, 0);
        let k = shape.offsets;
        let heads =
            [layer(width, k, 0, 0), layer(width, 7 * k, width, k), layer(width, 3 * k, 2 * width, 8 * k)];
        Self { shape, hidden, heads, parameters: next }
    }

    /// All layers.
    #[must_use]
    pub fn layers(&self) -> [LayerSpec; 4] {
        let [opacity, covariance, color] = self.heads;
        [self.hidden, opacity, covariance, color]
    }

    /// Rows of the networks' output.
    #[must_use]
    pub fn output_rows(&self) -> usize {
        11 * self.shape.offsets
    }

    /// Fresh parameters, uniform in plus or minus the inverse root of the input width (METHOD.md §2.2).
    #[must_use]
    pub fn initial(&self, rng: &mut impl Rng) -> Vec<f32> {
        let mut values = vec![0.0; self.parameters];
        for layer in std::iter::once(&self.hidden).chain(&self.heads) {
            let bound = 1.0 / (layer.inputs as f32).sqrt();
            for value in &mut values[layer.weights..layer.bias + layer.outputs] {
                *value = rng.random_range(-bound..bound);
            }
        }
        values
    }

    /// Which network (0 opacity, 1 covariance, 2 color) each parameter belongs to.
    #[must_use]
    pub fn owners(&self) -> Vec<u8> {
        let mut owners = vec![0; self.parameters];
        let width = self.shape.hidden;
        for input in 0..=self.hidden.inputs {
            for output in 0..self.hidden.outputs {
                owners[input * self.hidden.outputs + output] = (output / width) as u8;
            }
        }
        for (head, owner) in self.heads.iter().zip(0..) {
            owners[head.weights..head.bias + head.outputs].fill(owner);
        }
        owners
    }

    /// The parameters as the domain's networks.
    #[must_use]
    pub fn to_networks(&self, values: &[f32]) -> RenderNetworks {
        let width = self.shape.hidden;
        let part = |layer: &LayerSpec, first: usize, outputs: usize| layer.part(values, first, outputs);
        let mlp = |index: usize| Mlp {
            layers: vec![
                part(&self.hidden, index * width, width),
                part(&self.heads[index], 0, self.heads[index].outputs),
            ],
        };
        RenderNetworks { opacity: mlp(0), covariance: mlp(1), color: mlp(2) }
    }

    /// The flat array of the domain's networks, or what does not fit.
    ///
    /// # Errors
    /// A sentence if the networks do not have one hidden layer each, of the same width.
    pub fn from_networks(&self, networks: &RenderNetworks) -> Result<Vec<f32>, String> {
        let width = self.shape.hidden;
        let mut values = vec![0.0; self.parameters];
        for (index, mlp) in [&networks.opacity, &networks.covariance, &networks.color].into_iter().enumerate()
        {
            let [first, second] = mlp.layers.as_slice() else {
                return Err(format!(
                    "network {index} has {} layers; this renderer takes 2",
                    mlp.layers.len()
                ));
            };
            for (spec, layer, offset) in
                [(&self.hidden, first, index * width), (&self.heads[index], second, 0)]
            {
                let outputs = if std::ptr::eq(layer, first) { width } else { spec.outputs };
                if layer.inputs != spec.inputs || layer.outputs != outputs {
                    return Err(format!(
                        "network {index} has a {}x{} layer where {}x{outputs} is needed",
                        layer.inputs, layer.outputs, spec.inputs
                    ));
                }
                for output in 0..layer.outputs {
                    for input in 0..layer.inputs {
                        values[spec.weights + input * spec.outputs + offset + output] =
                            layer.weights[output * layer.inputs + input];
                    }
                    values[spec.bias + offset + output] = layer.bias[output];
                }
            }
        }
        Ok(values)
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn networks_survive_the_flat_layout() {
        let layout = NetworkLayout::new(ModelShape::new(8, 3));
        let values = layout.initial(&mut rand_pcg::Pcg64::seed_from_u64(1));
        assert_eq!(layout.from_networks(&layout.to_networks(&values)), Ok(values.clone()));
        assert!(values.iter().all(|value| *value != 0.0), "every parameter is initialized");
        assert_eq!(values.len(), (12 + 1) * 24 + (8 + 1) * 33);
    }

    #[test]
    fn every_parameter_belongs_to_its_network() {
        let layout = NetworkLayout::new(ModelShape::new(8, 3));
        let owners = layout.owners();
        let marks: Vec<f32> = owners.iter().map(|owner| f32::from(*owner)).collect();
        let networks = layout.to_networks(&marks);
        for (owner, mlp) in [(0.0, &networks.opacity), (1.0, &networks.covariance), (2.0, &networks.color)] {
            for layer in &mlp.layers {
                assert!(layer.weights.iter().chain(&layer.bias).all(|value| *value == owner));
            }
        }
    }
}
