//! The Gaussians of each tile, in blending order.

use glam::DVec2;

use super::{Projection, Splat};
use crate::{TILE, gpu::twin::scan};

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

/// Whether the splat reaches the cut-off anywhere in the rectangle of pixel centres from `low` to `high`. The least power
/// in a rectangle lies at the centre or on an edge that faces it.
#[must_use]
pub fn touches(splat: &Splat, low: DVec2, high: DVec2) -> bool {
    let power =
        |d: DVec2| 0.5 * (splat.conic.x * d.x * d.x + splat.conic.z * d.y * d.y) + splat.conic.y * d.x * d.y;
    let (low, high) = (low - splat.center, high - splat.center);
    let nearest = DVec2::ZERO.clamp(low, high);
    let along_y = (-splat.conic.y * nearest.x / splat.conic.z).clamp(low.y, high.y);
    let along_x = (-splat.conic.y * nearest.y / splat.conic.x).clamp(low.x, high.x);
    power(DVec2::new(nearest.x, along_y)).min(power(DVec2::new(along_x, nearest.y))) <= splat.level + 0.01
}

fn tiles_of(projection: &Projection, splat: &Splat) -> Vec<u32> {
    let tiles = projection.tiles();
    let size = f64::from(TILE);
    let first = ((splat.center - splat.extent - size + 0.5) / size).ceil().max(DVec2::ZERO);
    let last = ((splat.center + splat.extent - 0.5) / size).floor().min((tiles.as_dvec2()) - 1.0);
    let mut found = Vec::new();
    for y in first.y as i64..=last.y as i64 {
        for x in first.x as i64..=last.x as i64 {
            let low = DVec2::new(x as f64, y as f64) * size + 0.5;
            if touches(splat, low, low + size - 1.0) {
                found.push(y as u32 * tiles.x + x as u32);
            }
        }
    }
    found
}

/// The Gaussians that touch a tile, nearest first, equal depths in index order.
#[must_use]
pub fn compact(splats: &[Option<Splat>], tiles: &[u32]) -> Vec<u32> {
    let mut ids: Vec<u32> = (0..).take(splats.len()).filter(|id| tiles[*id as usize] > 0).collect();
    let depth = |id: &u32| splats[*id as usize].map_or(0.0, |splat| splat.depth);
    ids.sort_by(|a, b| depth(a).total_cmp(&depth(b)));
    ids
}

/// How many tiles each of `ids` touches.
#[must_use]
pub fn tile_counts(tiles: &[u32], ids: &[u32]) -> Vec<u32> {
    ids.iter().map(|id| tiles[*id as usize]).collect()
}

/// The tile of each slot: all tiles of the first of `ids`, then of the second, and so on.
#[must_use]
pub fn emit(projection: &Projection, splats: &[Option<Splat>], ids: &[u32]) -> Vec<(u32, u32)> {
    let mut pairs = Vec::new();
    for id in ids {
        if let Some(splat) = &splats[*id as usize] {
            pairs.extend(tiles_of(projection, splat).into_iter().map(|tile| (tile, *id)));
        }
    }
    pairs
}

/// Begin and end of each tile among pairs sorted by tile.
#[must_use]
pub fn tile_ranges(tiles: usize, sorted: &[u32]) -> Vec<[u32; 2]> {
    let mut ranges = vec![[0, 0]; tiles];
    for (tile, i) in sorted.iter().zip(0..) {
        let range = &mut ranges[*tile as usize];
        if range[1] == 0 {
            range[0] = i;
        }
        range[1] = i + 1;
    }
    ranges
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
