//! The second step of a scan of blocks: all prefix sums.

use super::scan;
use crate::gpu::BLOCK;

/// The prefix sums of all values from the partial sums of [`scan_block_sums`](fn@super::scan_block_sums), and the total.
#[must_use]
pub fn scan_blocks(values: &[u32], partials: &[u32]) -> (Vec<u32>, u32) {
    let (starts, total) = scan(&partials[1..]);
    let from = |(block, start): (&[u32], &u32)| {
        scan(block).0.into_iter().map(|sum| sum.saturating_add(*start)).collect::<Vec<_>>()
    };
    (values.chunks(BLOCK).zip(&starts).flat_map(from).collect(), total)
}
