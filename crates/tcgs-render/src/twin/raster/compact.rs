//! The Gaussians in blending order.

use crate::twin::Splat;

/// The Gaussians that touch a tile, nearest first, equal depths in index order.
#[must_use]
pub fn compact(splats: &[Option<Splat>], tiles: &[u32]) -> Vec<u32> {
    let mut ids: Vec<u32> = (0..).take(splats.len()).filter(|id| tiles[*id as usize] > 0).collect();
    let depth = |id: &u32| splats[*id as usize].map_or(0.0, |splat| splat.depth);
    ids.sort_by(|a, b| depth(a).total_cmp(&depth(b)));
    ids
}
