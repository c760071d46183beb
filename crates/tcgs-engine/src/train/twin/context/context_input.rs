//! From planes to the networks' input.

use super::corners::corners;
use crate::{
    domain::context_model::POSITION_INPUTS,
    train::context::{ContextAnchors, ContextConfig},
};

/// The input of one anchor: plane by plane the samples of each neighbor, then the position prior. Planes are
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
    for neighbor in &anchors.neighbors[anchor * sampled..][..sampled] {
        for plane in 0..3 {
            let corners = corners(anchors.texels[3 * *neighbor as usize + plane], edge);
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
