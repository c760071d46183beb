//! The last step of a scan: all prefix sums.

use crate::gpu::twin::owned::owned;

/// The prefix sums of all values from those of the runs.
#[must_use]
pub fn scan_apply(values: &[u32], starts: &[u32]) -> Vec<u32> {
    let mut sums = Vec::with_capacity(values.len());
    for (run, start) in starts.iter().enumerate() {
        let mut sum = *start;
        for value in &values[owned(values.len(), starts.len(), run)] {
            sums.push(sum);
            sum = sum.saturating_add(*value);
        }
    }
    sums
}
