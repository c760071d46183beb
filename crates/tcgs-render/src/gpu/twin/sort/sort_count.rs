//! The first step of a pass of the sort: the counts of digits in each run.

use crate::gpu::twin::owned::owned;

/// How often each digit occurs in each run, `[digit][run]`; the digit of a key is `(key >> shift) % digits`.
#[must_use]
pub fn sort_count(keys: &[u32], shift: u32, digits: u32, runs: usize) -> Vec<u32> {
    let mut counters = vec![0; digits as usize * runs];
    for run in 0..runs {
        for key in &keys[owned(keys.len(), runs, run)] {
            counters[((key >> shift) % digits) as usize * runs + run] += 1;
        }
    }
    counters
}
