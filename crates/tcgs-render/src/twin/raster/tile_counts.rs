//! The numbers of tiles in blending order.

/// How many tiles each of `ids` touches.
#[must_use]
pub fn tile_counts(tiles: &[u32], ids: &[u32]) -> Vec<u32> {
    ids.iter().map(|id| tiles[*id as usize]).collect()
}
