//! The bound on the memory that one input may take.

use peak_alloc::PeakAlloc;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// As [`tcgs::ingest`] states it for a check of any input, and a load within a small budget.
const MAX_BYTES: usize = 128 << 20;

/// Runs a target and panics if it took more.
pub fn bounded(target: fn(&[u8]), data: &[u8]) {
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    target(data);
    let taken = MEMORY.peak_usage().saturating_sub(before);
    assert!(taken <= MAX_BYTES, "{taken} bytes of memory for {} bytes of input", data.len());
}
