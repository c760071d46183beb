//! The last step of a pass of the sort: every pair goes to its place.

use crate::gpu::twin::{owned::owned, scan};

/// One stable pass: each pair goes to the place of its digit and run, runs and pairs in order.
#[must_use]
pub fn sort_scatter(
    pairs: &[(u32, u32)],
    shift: u32,
    digits: u32,
    offsets: &[u32],
    totals: &[u32],
) -> Vec<(u32, u32)> {
    let runs = offsets.len() / digits as usize;
    let (bases, _) = scan(totals);
    let mut next: Vec<u32> = offsets.iter().enumerate().map(|(i, offset)| offset + bases[i / runs]).collect();
    let mut sorted = vec![(0, 0); pairs.len()];
    for run in 0..runs {
        for pair in &pairs[owned(pairs.len(), runs, run)] {
            let place = &mut next[((pair.0 >> shift) % digits) as usize * runs + run];
            sorted[*place as usize] = *pair;
            *place += 1;
        }
    }
    sorted
}
