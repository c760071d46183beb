//! The second step of a scan: where each run starts.

use super::scan;

/// The sums of the runs before each run, and the total.
#[must_use]
pub fn scan_partials(partials: &[u32]) -> (Vec<u32>, u32) {
    scan(partials)
}
