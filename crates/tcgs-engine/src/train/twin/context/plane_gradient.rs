//! From the gradients by samples to those by planes.

use super::corners::corners;
use crate::train::context::{ContextAnchors, ContextConfig};

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
