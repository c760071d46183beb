//! The tile of each slot.

use super::touched_tiles::tiles_of;
use crate::{Projection, twin::Splat};

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
