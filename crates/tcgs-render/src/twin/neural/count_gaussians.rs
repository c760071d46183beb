//! How many Gaussians there are.

use crate::{model::ModelShape, twin::Gaussian};

/// Candidate Gaussians, Gaussians, and visible anchors.
#[must_use]
pub fn count_gaussians(shape: ModelShape, list: &[u32], gaussians: &[Option<Gaussian>]) -> [u32; 3] {
    [list.len() * shape.offsets, gaussians.iter().flatten().count(), list.len()].map(|count| count as u32)
}
