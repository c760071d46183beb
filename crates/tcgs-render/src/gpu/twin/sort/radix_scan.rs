//! The second step of a pass of the sort of blocks: prefix sums of the counts.

use super::sort_offsets;

/// For each digit the exclusive prefix sums of its counters over the blocks, and its total.
#[must_use]
pub fn radix_scan(counters: &[u32], blocks: usize) -> (Vec<u32>, Vec<u32>) {
    sort_offsets(counters, blocks)
}
