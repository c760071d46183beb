//! The offsets of an anchor that a view can show.

use glam::DVec3;

use super::spawn_gaussians;
use crate::model::ModelShape;

/// The offsets of one anchor that a view can show: bit k is set if offset k makes a Gaussian whose opacity reaches a pixel
/// (METHOD.md §3.2).
#[must_use]
pub fn visible_offsets(position: DVec3, shape: ModelShape, row: &[f64], mask: u32, outputs: &[f64]) -> u32 {
    const MIN_OPACITY: f64 = 1.0 / 255.0;
    spawn_gaussians(position, shape, row, mask, outputs)
        .iter()
        .enumerate()
        .filter(|(_, gaussian)| gaussian.is_some_and(|gaussian| gaussian.opacity >= MIN_OPACITY))
        .fold(0, |shown, (k, _)| shown | 1 << k)
}
