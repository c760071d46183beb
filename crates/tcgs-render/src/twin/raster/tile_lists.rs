//! The Gaussians of each tile, in blending order.

use super::{compact, emit, tile_counts, tile_ranges, touched_tiles::tiles_of};
use crate::{Projection, gpu::twin::scan, twin::Splat};

/// The tiles' lists and the slots of each Gaussian.
#[derive(Debug, Clone, Default)]
pub struct TileLists {
    /// Tiles that each Gaussian touches.
    pub tiles: Vec<u32>,
    /// First slot of each Gaussian; its slots follow one another.
    pub first_slots: Vec<u32>,
    /// Gaussian of each slot.
    pub slot_ids: Vec<u32>,
    /// Slots by tile, nearest first within a tile.
    pub slots: Vec<u32>,
    /// Begin and end of each tile in `slots`.
    pub ranges: Vec<[u32; 2]>,
}

/// The lists of all tiles.
#[must_use]
pub fn tile_lists(projection: &Projection, splats: &[Option<Splat>]) -> TileLists {
    let tiles: Vec<u32> = splats
        .iter()
        .map(|splat| splat.as_ref().map_or(0, |splat| tiles_of(projection, splat).len() as u32))
        .collect();
    let ids = compact(splats, &tiles);
    let pairs = emit(projection, splats, &ids);
    let (starts, _) = scan(&tile_counts(&tiles, &ids));
    let mut first_slots = vec![0; splats.len()];
    for (id, start) in ids.iter().zip(starts) {
        first_slots[*id as usize] = start;
    }
    let mut slots: Vec<u32> = (0..).take(pairs.len()).collect();
    slots.sort_by_key(|slot| pairs[*slot as usize].0);
    let sorted: Vec<u32> = slots.iter().map(|slot| pairs[*slot as usize].0).collect();
    let count = projection.tiles().element_product() as usize;
    let slot_ids = pairs.into_iter().map(|(_, id)| id).collect();
    TileLists { tiles, first_slots, slot_ids, slots, ranges: tile_ranges(count, &sorted) }
}
