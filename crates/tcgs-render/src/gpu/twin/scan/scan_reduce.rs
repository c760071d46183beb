//! The first step of a scan: the sum of each run.

use super::scan;
use crate::gpu::twin::owned::owned;

/// The saturating sum of each run.
#[must_use]
pub fn scan_reduce(values: &[u32], runs: usize) -> Vec<u32> {
    (0..runs).map(|run| scan(&values[owned(values.len(), runs, run)]).1).collect()
}
