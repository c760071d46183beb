//! The sums of the slots of each Gaussian.

use super::TileLists;
use crate::twin::SplatGradient;

/// Sums each Gaussian's slots in order.
#[must_use]
pub fn gather(lists: &TileLists, slots: &[SplatGradient]) -> Vec<SplatGradient> {
    let mut sums = vec![SplatGradient::default(); lists.tiles.len()];
    for (sum, (first, count)) in sums.iter_mut().zip(lists.first_slots.iter().zip(&lists.tiles)) {
        for slot in &slots[*first as usize..(*first + *count) as usize] {
            sum.center += slot.center;
            sum.opacity += slot.opacity;
            sum.conic += slot.conic;
            sum.color += slot.color;
        }
    }
    sums
}
