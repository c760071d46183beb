//! From planes to the networks' input, and back.

use crate::{
    domain::context_model::POSITION_INPUTS,
    train::context::{ContextAnchors, ContextConfig},
};

/// The bilinear sample of one channel of a plane, as texels with weights. A place is a texel's word of [`ContextAnchors`].
fn corners(texel: u32, edge: usize) -> [(usize, f64); 4] {
    let [x, y, fx, fy] = texel.to_le_bytes();
    let (x, y) = (usize::from(x), usize::from(y));
    let (fx, fy) = (f64::from(fx) / 256.0, f64::from(fy) / 256.0);
    let (right, below) = ((x + 1).min(edge - 1), (y + 1).min(edge - 1));
    [
        (y * edge + x, (1.0 - fx) * (1.0 - fy)),
        (y * edge + right, fx * (1.0 - fy)),
        (below * edge + x, (1.0 - fx) * fy),
        (below * edge + right, fx * fy),
    ]
}

/// The input of one anchor: plane by plane the samples of each neighbour, then the position prior. Planes are
/// `[3][channels][edge][edge]`.
#[must_use]
pub fn context_input(
    config: &ContextConfig,
    anchors: &ContextAnchors,
    planes: &[f64],
    anchor: usize,
) -> Vec<f64> {
    let (sampled, channels, edge) = (config.kind.sampled(), config.planes.channels, config.planes.edge);
    let mut input = Vec::with_capacity(config.inputs());
    for neighbour in &anchors.neighbours[anchor * sampled..][..sampled] {
        for plane in 0..3 {
            let corners = corners(anchors.texels[3 * *neighbour as usize + plane], edge);
            for channel in 0..channels {
                let values = &planes[(plane * channels + channel) * edge * edge..];
                input.push(corners.iter().map(|(at, weight)| weight * values[*at]).sum());
            }
        }
    }
    let prior = &anchors.priors[anchor * POSITION_INPUTS..][..POSITION_INPUTS];
    input.extend(prior.iter().map(|value| f64::from(*value)));
    input
}

/// Gradients by the samples at each anchor, `[N][3 channels]`, from those by the inputs of the sampled ones.
#[must_use]
pub fn neighbour_gradient(
    config: &ContextConfig,
    anchors: &ContextAnchors,
    sample: &[u32],
    d_inputs: &[Vec<f64>],
) -> Vec<f64> {
    let (sampled, width) = (config.kind.sampled(), 3 * config.planes.channels);
    let mut d_samples = vec![0.0; anchors.count * width];
    for (anchor, d_input) in sample.iter().zip(d_inputs) {
        let neighbours = &anchors.neighbours[*anchor as usize * sampled..][..sampled];
        for (neighbour, d) in neighbours.iter().zip(d_input.chunks_exact(width)) {
            let place = &mut d_samples[*neighbour as usize * width..][..width];
            place.iter_mut().zip(d).for_each(|(sum, d)| *sum += d);
        }
    }
    d_samples
}

/// Gradients by the planes from those by the samples at each anchor.
#[must_use]
pub fn plane_gradient(config: &ContextConfig, anchors: &ContextAnchors, d_samples: &[f64]) -> Vec<f64> {
    let (channels, edge) = (config.planes.channels, config.planes.edge);
    let mut d_planes = vec![0.0; config.planes.plane_values()];
    for (place, texel) in anchors.texels.iter().enumerate() {
        for channel in 0..channels {
            let d = d_samples[place * channels + channel];
            let first = (place % 3 * channels + channel) * edge * edge;
            for (at, weight) in corners(*texel, edge) {
                d_planes[first + at] += weight * d;
            }
        }
    }
    d_planes
}
