//! The first step of a pass of the sort of blocks: the counts of digits in each block.

use crate::gpu::BLOCK;

/// How often each digit occurs in each block, `[digit][block]`; the digit of a key is `(key >> shift) % digits`.
#[must_use]
pub fn radix_histogram(keys: &[u32], shift: u32, digits: u32) -> Vec<u32> {
    let blocks = keys.len().div_ceil(BLOCK);
    let mut counters = vec![0; digits as usize * blocks];
    for (block, keys) in keys.chunks(BLOCK).enumerate() {
        for key in keys {
            counters[((key >> shift) % digits) as usize * blocks + block] += 1;
        }
    }
    counters
}
