//! Evaluates the render networks of one anchor for many views at once, in f32 on the host.
//!
//! A column is a view. The first layer's product with the feature is the same in all columns and computed once; rows of the last layer are
//! computed on request, since most offsets of an anchor make no Gaussian.

use crate::domain::{DenseLayer, Mlp, ViewDegree};

/// Inputs of the networks besides the feature, `[inputs][views]`: unit direction, distance in the scene's unit, harmonics.
#[derive(Debug, Clone)]
pub(super) struct ViewInputs {
    rows: Vec<Vec<f32>>,
}

impl ViewInputs {
    /// Of no view.
    pub(super) fn new(view_degree: ViewDegree) -> Self {
        Self { rows: vec![Vec::new(); view_degree.inputs()] }
    }

    pub(super) fn push(&mut self, values: impl Iterator<Item = f32>) {
        self.rows.iter_mut().zip(values).for_each(|(row, value)| row.push(value));
    }

    pub(super) fn len(&self) -> usize {
        self.rows[0].len()
    }
}

/// One network with one anchor's feature in many views, evaluated up to its last layer.
#[derive(Debug)]
pub(super) struct Evaluated<'a> {
    mlp: &'a Mlp,
    feature: &'a [f32],
    views: &'a ViewInputs,
    /// Inputs of the last layer, `[inputs][views]`; empty for a single layer.
    hidden: Vec<f32>,
}

impl<'a> Evaluated<'a> {
    /// `mlp` must pass `AnchorScene::check` for the feature's width.
    pub(super) fn new(mlp: &'a Mlp, feature: &'a [f32], views: &'a ViewInputs) -> Self {
        let mut evaluated = Self { mlp, feature, views, hidden: Vec::new() };
        for layer in 0..mlp.layers.len().saturating_sub(1) {
            let count = views.len();
            let mut next = vec![0.0; mlp.layers[layer].outputs * count];
            for (output, column) in next.chunks_exact_mut(count.max(1)).enumerate() {
                evaluated.output(layer, output, column);
                column.iter_mut().for_each(|value| *value = value.max(0.0));
            }
            evaluated.hidden = next;
        }
        evaluated
    }

    /// Output `index` of the network in every view.
    pub(super) fn row(&self, index: usize) -> Vec<f32> {
        let mut values = vec![0.0; self.views.len()];
        if let Some(last) = self.mlp.layers.len().checked_sub(1) {
            self.output(last, index, &mut values);
        }
        values
    }

    fn output(&self, layer: usize, output: usize, values: &mut [f32]) {
        let DenseLayer { inputs, weights, bias, .. } = &self.mlp.layers[layer];
        let weights = &weights[output * inputs..][..*inputs];
        if layer == 0 {
            let (of_feature, of_view) = weights.split_at(self.feature.len());
            let same: f32 = of_feature.iter().zip(self.feature).map(|(w, x)| w * x).sum();
            values.fill(same + bias[output]);
            for (weight, row) in of_view.iter().zip(&self.views.rows) {
                add_scaled(values, *weight, row);
            }
        } else {
            values.fill(bias[output]);
            for (weight, row) in weights.iter().zip(self.hidden.chunks_exact(values.len().max(1))) {
                add_scaled(values, *weight, row);
            }
        }
    }
}

fn add_scaled(values: &mut [f32], weight: f32, row: &[f32]) {
    values.iter_mut().zip(row).for_each(|(value, x)| *value += weight * x);
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};

    use super::*;

    #[test]
    fn many_views_at_once_are_the_layers_one_by_one() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(5);
        for widths in [&[9, 3][..], &[9, 5, 3], &[9, 6, 4, 3]] {
            let layers = widths
                .windows(2)
                .map(|pair| DenseLayer {
                    inputs: pair[0],
                    outputs: pair[1],
                    weights: (0..pair[0] * pair[1]).map(|_| rng.random_range(-1.0..1.0)).collect(),
                    bias: (0..pair[1]).map(|_| rng.random_range(-1.0..1.0)).collect(),
                })
                .collect();
            let mlp = Mlp { layers };
            let feature: Vec<f32> = (0..5).map(|_| rng.random_range(-1.0..1.0)).collect();
            let mut views = ViewInputs::new(ViewDegree::DEFAULT);
            let mut inputs = Vec::new();
            for _ in 0..7 {
                let view = [(); 4].map(|()| rng.random_range(-1.0..1.0));
                views.push(view.into_iter());
                inputs.push([feature.as_slice(), &view].concat());
            }
            let evaluated = Evaluated::new(&mlp, &feature, &views);
            for (view, input) in inputs.into_iter().enumerate() {
                let mut x = input;
                for (index, layer) in mlp.layers.iter().enumerate() {
                    let last = index + 1 == mlp.layers.len();
                    x = (0..layer.outputs)
                        .map(|output| {
                            let weights = &layer.weights[output * layer.inputs..][..layer.inputs];
                            let y =
                                weights.iter().zip(&x).map(|(w, x)| w * x).sum::<f32>() + layer.bias[output];
                            if last { y } else { y.max(0.0) }
                        })
                        .collect();
                }
                for (output, expected) in x.into_iter().enumerate() {
                    assert!((evaluated.row(output)[view] - expected).abs() < 1e-5, "{widths:?}");
                }
            }
        }
    }

    #[test]
    fn no_view_is_no_column() {
        let layer =
            |inputs| DenseLayer { inputs, outputs: 2, weights: vec![1.0; inputs * 2], bias: vec![0.0; 2] };
        let mlp = Mlp { layers: vec![layer(5), layer(2)] };
        assert!(Evaluated::new(&mlp, &[1.0], &ViewInputs::new(ViewDegree::DEFAULT)).row(1).is_empty());
    }
}
