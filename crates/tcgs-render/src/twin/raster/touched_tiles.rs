//! The tiles that a splat touches.

use glam::DVec2;

use crate::{Projection, TILE, twin::Splat};

/// Whether the splat reaches the cut-off anywhere in the rectangle of pixel centers from `low` to `high`. The least power
/// in a rectangle lies at the center or on an edge that faces it.
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

pub(super) fn tiles_of(projection: &Projection, splat: &Splat) -> Vec<u32> {
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
