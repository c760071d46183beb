//! From the gradients by the networks' inputs to those by samples.

use crate::train::context::{ContextAnchors, ContextConfig};

/// Gradients by the samples at each anchor, `[N][3 channels]`, from those by the inputs of the sampled ones.
#[must_use]
pub fn neighbor_gradient(
    config: &ContextConfig,
    anchors: &ContextAnchors,
    sample: &[u32],
    d_inputs: &[Vec<f64>],
) -> Vec<f64> {
    let (sampled, width) = (config.kind.sampled(), 3 * config.planes.channels);
    let mut d_samples = vec![0.0; anchors.count * width];
    for (anchor, d_input) in sample.iter().zip(d_inputs) {
        let neighbors = &anchors.neighbors[*anchor as usize * sampled..][..sampled];
        for (neighbor, d) in neighbors.iter().zip(d_input.chunks_exact(width)) {
            let place = &mut d_samples[*neighbor as usize * width..][..width];
            place.iter_mut().zip(d).for_each(|(sum, d)| *sum += d);
        }
    }
    d_samples
}
