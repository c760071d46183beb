//! The context model in floats, as trained: the reference for the integers of a file. No file depends on it.

use super::{coordinates, neighbors, position_inputs, texels};
use crate::domain::{ContextFrame, Mlp, Planes, context_model::ContextKind};

/// Inputs of the float networks for each anchor.
pub(crate) struct FloatAnchors {
    coordinates: Vec<[i32; 3]>,
    neighbors: Vec<[u32; 4]>,
    /// Texels along an edge of the planes, and their channels.
    edge: usize,
    channels: usize,
    /// `[3][channels][edge][edge]`.
    planes: Vec<f64>,
}

impl FloatAnchors {
    /// The anchors at `cells`, in file order.
    pub(crate) fn new(frame: &ContextFrame, cells: &[[i32; 3]], planes: Option<&Planes>) -> Self {
        Self {
            coordinates: coordinates(frame, cells),
            neighbors: neighbors(cells),
            edge: planes.map_or(1, Planes::plane_edge),
            channels: planes.map_or(0, Planes::plane_channels),
            planes: planes.map(up_sampled).unwrap_or_default(),
        }
    }

    /// Outputs of a network for an anchor: means, base-2 logarithms of standard deviations, and the step adjustment.
    pub(crate) fn outputs(&self, mlp: &Mlp, kind: ContextKind, anchor: usize) -> Vec<f64> {
        let mut values = Vec::new();
        for near in &self.neighbors[anchor][..kind.sampled()] {
            self.sample(*near as usize, &mut values);
        }
        values.extend(position_inputs(self.coordinates[anchor]).map(|value| f64::from(value) / 256.0));
        for (index, layer) in mlp.layers.iter().enumerate() {
            if index > 0 {
                values.iter_mut().for_each(|value| *value = value.max(0.0));
            }
            let rows = layer.weights.chunks(layer.inputs).zip(&layer.bias);
            values = rows
                .map(|(row, bias)| {
                    row.iter().zip(&values).fold(f64::from(*bias), |sum, (w, x)| sum + f64::from(*w) * x)
                })
                .collect();
        }
        values
    }

    fn sample(&self, anchor: usize, values: &mut Vec<f64>) {
        let size = self.edge * self.edge;
        for (plane, texel) in texels(self.coordinates[anchor], self.edge).iter().enumerate() {
            let (fx, fy) = (f64::from(texel.fx) / 256.0, f64::from(texel.fy) / 256.0);
            for channel in 0..self.channels {
                let image = &self.planes[(plane * self.channels + channel) * size..][..size];
                let row = |y: u32| {
                    let at = |x: u32| image[y as usize * self.edge + x as usize];
                    at(texel.x0) * (1.0 - fx) + at(texel.x1) * fx
                };
                values.push(row(texel.y0) * (1.0 - fy) + row(texel.y1) * fy);
            }
        }
    }
}

/// Planes by the definition of [`crate::domain::UpLayer`].
pub(super) fn up_sampled(planes: &Planes) -> Vec<f64> {
    let mut edge = planes.edge;
    let mut values: Vec<f64> = planes.latents.iter().map(|latent| f64::from(*latent)).collect();
    for (index, layer) in planes.layers.iter().enumerate() {
        let (size, wide) = (edge * edge, 2 * edge);
        let mut next = vec![0.0; 3 * layer.outputs * wide * wide];
        for (image, next) in next.chunks_mut(wide * wide).enumerate() {
            let (plane, output) = (image / layer.outputs, image % layer.outputs);
            next.fill(f64::from(layer.bias[output]));
            for input in 0..layer.inputs {
                let from = &values[(plane * layer.inputs + input) * size..][..size];
                let taps = &layer.weights[(input * layer.outputs + output) * 9..][..9];
                for (place, value) in from.iter().enumerate() {
                    for (tap, weight) in taps.iter().enumerate() {
                        let along =
                            |at: usize, tap: usize| (2 * at + tap).checked_sub(1).filter(|at| *at < wide);
                        if let (Some(x), Some(y)) =
                            (along(place % edge, tap % 3), along(place / edge, tap / 3))
                        {
                            next[y * wide + x] += value * f64::from(*weight);
                        }
                    }
                }
            }
            if index + 1 < planes.layers.len() {
                next.iter_mut().for_each(|value| *value = value.max(0.0));
            }
        }
        (values, edge) = (next, wide);
    }
    values
}
