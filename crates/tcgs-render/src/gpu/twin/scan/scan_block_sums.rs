//! The first step of a scan of blocks: the sum of each.

use super::scan;
use crate::gpu::BLOCK;

/// The number of values, then the saturating sum of each block.
#[must_use]
pub fn scan_block_sums(values: &[u32]) -> Vec<u32> {
    std::iter::once(values.len() as u32).chain(values.chunks(BLOCK).map(|block| scan(block).1)).collect()
}
