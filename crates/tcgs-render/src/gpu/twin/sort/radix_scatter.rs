//! The last step of a pass of the sort of blocks: every pair goes to its place.

use crate::gpu::{BLOCK, twin::scan};

/// One stable pass: each pair goes to the place of its digit and block, blocks and pairs in order.
#[must_use]
pub fn radix_scatter(
    pairs: &[(u32, u32)],
    shift: u32,
    digits: u32,
    counters: &[u32],
    totals: &[u32],
) -> Vec<(u32, u32)> {
    let blocks = pairs.len().div_ceil(BLOCK);
    let (bases, _) = scan(totals);
    let mut sorted = vec![(0, 0); pairs.len()];
    for (block, pairs) in pairs.chunks(BLOCK).enumerate() {
        let mut next: Vec<usize> = (0..digits as usize)
            .map(|digit| (bases[digit] + counters[digit * blocks + block]) as usize)
            .collect();
        for pair in pairs {
            let place = &mut next[((pair.0 >> shift) % digits) as usize];
            sorted[*place] = *pair;
            *place += 1;
        }
    }
    sorted
}
