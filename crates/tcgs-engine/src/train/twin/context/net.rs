//! The whole context model: forward from parameters to outputs, backward to every parameter.

use super::{
    context_input, conv_down, conv_up, conv_weight_gradient, neighbor_gradient, plane_gradient, plane_l1,
    round_latents, round_weights,
};
use crate::{
    render::twin::neural::{dense, dense_input_gradient, dense_weight_gradient, relu, relu_gate},
    train::context::{ContextAnchors, ContextLayout, ContextPass, PlaneSource},
};

/// A pass over a sample of anchors.
#[derive(Debug, Clone)]
pub struct ContextTwin<'a> {
    /// Where the parameters are.
    pub layout: &'a ContextLayout,
    /// Where the anchors are.
    pub anchors: &'a ContextAnchors,
    /// Which of them.
    pub sample: &'a [u32],
    /// How.
    pub pass: ContextPass,
    /// Whether latents are rounded; central differences know nothing of gradients that pass through it.
    pub rounds: bool,
}

/// What the forward pass leaves.
#[derive(Debug, Clone, Default)]
pub struct ContextForward {
    /// The parameters in the form in which they were used.
    pub stored: Vec<f64>,
    /// Outputs of the layers down.
    pub down: Vec<Vec<f64>>,
    /// Latents as they went up, then the outputs of the layers up.
    pub up: Vec<Vec<f64>>,
    /// The planes that were sampled.
    pub planes: Vec<f64>,
    /// Each sampled anchor's input.
    pub inputs: Vec<Vec<f64>>,
    /// Its hidden values.
    pub hidden: Vec<Vec<f64>>,
    /// Its outputs, a group after the other.
    pub outputs: Vec<Vec<f64>>,
    /// The weighted difference of planes and reconstruction.
    pub reconstruction_loss: f64,
}

impl ContextTwin<'_> {
    fn has_planes(&self) -> bool {
        !self.layout.planes.is_empty()
    }

    fn adds_reconstruction(&self) -> bool {
        self.pass.reconstruction > 0.0
            && self.pass.source != PlaneSource::Latents
            && !self.layout.up.is_empty()
    }

    /// From parameters to outputs.
    #[must_use]
    pub fn forward(&self, values: &[f64]) -> ContextForward {
        let layout = self.layout;
        let mut on = ContextForward { stored: self.stored(values), ..ContextForward::default() };
        if self.has_planes() {
            let raw = &values[layout.planes.clone()];
            let mut latents = values[layout.latents.clone()].to_vec();
            if self.pass.source != PlaneSource::Latents {
                let mut source = raw.to_vec();
                for (index, layer) in layout.down.iter().enumerate() {
                    source = conv_down(layer, values, Some(layer.bias), &source);
                    if index + 1 < layout.down.len() {
                        source = relu(source);
                    }
                    on.down.push(source.clone());
                }
                latents = source;
            }
            on.up.push(if self.rounds { round_latents(&latents) } else { latents });
            for (index, layer) in layout.up.iter().enumerate() {
                let up = conv_up(layer, &on.stored, Some(layer.bias), &on.up[index]);
                on.up.push(if index + 1 < layout.up.len() { relu(up) } else { up });
            }
            let reconstructed = on.up[layout.up.len()].clone();
            if self.adds_reconstruction() {
                let weight = f64::from(self.pass.reconstruction);
                on.reconstruction_loss = plane_l1(raw, &reconstructed, weight).0;
            }
            on.planes = if self.pass.source == PlaneSource::Raw { raw.to_vec() } else { reconstructed };
        }
        for anchor in self.sample {
            let input = context_input(&layout.config, self.anchors, &on.planes, *anchor as usize);
            let hidden = relu(dense(&layout.hidden, &on.stored, &input));
            let outputs = layout.heads.iter().flat_map(|head| dense(head, &on.stored, &hidden)).collect();
            on.inputs.push(input);
            on.hidden.push(hidden);
            on.outputs.push(outputs);
        }
        on
    }

    /// Gradients by all parameters from those by the outputs.
    #[must_use]
    pub fn backward(&self, values: &[f64], on: &ContextForward, d_outputs: &[Vec<f64>]) -> Vec<f64> {
        let layout = self.layout;
        let mut gradients = vec![0.0; layout.parameters];
        let mut d_hidden = vec![vec![0.0; layout.hidden.outputs]; self.sample.len()];
        for head in &layout.heads {
            dense_weight_gradient(head, &on.hidden, d_outputs, &mut gradients);
            for (d_output, d_hidden) in d_outputs.iter().zip(&mut d_hidden) {
                dense_input_gradient(head, &on.stored, d_output, d_hidden);
            }
        }
        let d_hidden: Vec<_> = on.hidden.iter().zip(d_hidden).map(|(h, d)| relu_gate(h, d)).collect();
        dense_weight_gradient(&layout.hidden, &on.inputs, &d_hidden, &mut gradients);
        if !self.has_planes() || !self.pass.planes_learn {
            return gradients;
        }
        let sampled = layout.config.sampled_inputs();
        let d_inputs: Vec<Vec<f64>> = d_hidden
            .iter()
            .map(|d| {
                let mut d_input = vec![0.0; layout.hidden.inputs];
                dense_input_gradient(&layout.hidden, &on.stored, d, &mut d_input);
                d_input[..sampled].to_vec()
            })
            .collect();
        let d_samples = neighbor_gradient(&layout.config, self.anchors, self.sample, &d_inputs);
        let d_planes = plane_gradient(&layout.config, self.anchors, &d_samples);
        self.plane_gradients(values, on, d_planes, &mut gradients);
        gradients
    }

    fn plane_gradients(
        &self,
        values: &[f64],
        on: &ContextForward,
        d_planes: Vec<f64>,
        gradients: &mut [f64],
    ) {
        let layout = self.layout;
        let zeros = vec![0.0; d_planes.len()];
        let (mut d_raw, mut d_up) =
            if self.pass.source == PlaneSource::Raw { (d_planes, zeros) } else { (zeros, d_planes) };
        if self.adds_reconstruction() {
            let raw = &values[layout.planes.clone()];
            let d = plane_l1(raw, &on.up[layout.up.len()], f64::from(self.pass.reconstruction)).1;
            d_raw.iter_mut().zip(&d).for_each(|(sum, d)| *sum += d);
            d_up.iter_mut().zip(&d).for_each(|(sum, d)| *sum -= d);
        }
        let mut put =
            |first: usize, values: &[f64]| gradients[first..][..values.len()].copy_from_slice(values);
        for (index, layer) in layout.up.iter().enumerate().rev() {
            let source = &on.up[index];
            let (weights, bias) = conv_weight_gradient(layer, &d_up, source, true);
            put(layer.weights, &weights);
            put(layer.bias, &bias);
            d_up = conv_down(layer, &on.stored, None, &d_up);
            if index > 0 {
                d_up = relu_gate(source, d_up);
            }
        }
        if self.pass.source == PlaneSource::Latents {
            put(layout.latents.start, &d_up);
            return;
        }
        let raw = &values[layout.planes.clone()];
        for (index, layer) in layout.down.iter().enumerate().rev() {
            let source = if index == 0 { raw } else { &on.down[index - 1] };
            let (weights, bias) = conv_weight_gradient(layer, source, &d_up, false);
            put(layer.weights, &weights);
            put(layer.bias, &bias);
            d_up = conv_up(layer, values, None, &d_up);
            if index > 0 {
                d_up = relu_gate(source, d_up);
            }
        }
        d_raw.iter_mut().zip(&d_up).for_each(|(sum, d)| *sum += d);
        put(layout.planes.start, &d_raw);
    }

    /// The parameters with what a file holds rounded.
    fn stored(&self, values: &[f64]) -> Vec<f64> {
        let mut stored = values.to_vec();
        let Some(levels) = self.pass.levels else { return stored };
        let mut round = |places: Vec<usize>, levels: u8| {
            let row: Vec<f64> = places.iter().map(|place| values[*place]).collect();
            for (place, value) in places.into_iter().zip(round_weights(&row, levels)) {
                stored[place] = value;
            }
        };
        for layer in std::iter::once(&self.layout.hidden).chain(&self.layout.heads) {
            for output in 0..layer.outputs {
                let weight = |input: usize| layer.weights + input * layer.outputs + output;
                round((0..layer.inputs).map(weight).collect(), levels);
            }
        }
        for layer in &self.layout.up {
            for output in 0..layer.fine {
                let block = |input: usize| layer.weights + (input * layer.fine + output) * 9;
                round((0..layer.coarse).flat_map(|input| block(input)..block(input) + 9).collect(), 127);
            }
        }
        stored
    }
}
