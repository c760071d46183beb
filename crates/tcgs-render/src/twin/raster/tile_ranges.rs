//! Where the slots of each tile begin and end.

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
