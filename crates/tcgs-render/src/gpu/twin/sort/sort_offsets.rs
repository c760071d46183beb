//! The second step of a pass of the sort: prefix sums of the counts.

use crate::gpu::twin::scan;

/// For each digit the exclusive prefix sums of its counters over the runs, and its total.
#[must_use]
pub fn sort_offsets(counters: &[u32], runs: usize) -> (Vec<u32>, Vec<u32>) {
    let (offsets, totals): (Vec<_>, Vec<_>) = counters.chunks(runs).map(scan).unzip();
    (offsets.concat(), totals)
}
