//! The list of visible anchors, block by block.

use crate::gpu::{BLOCK, twin::scan};

/// The visible anchors in ascending order, from the counts of their blocks.
#[must_use]
pub fn list_visible_anchors(visible: &[bool], block_counts: &[u32]) -> Vec<u32> {
    let (starts, total) = scan(block_counts);
    let mut list = vec![0; total as usize];
    for (block, (flags, start)) in visible.chunks(BLOCK).zip(starts).enumerate() {
        let set = (0..).zip(flags).filter(|(_, flag)| **flag).map(|(i, _)| (block * BLOCK) as u32 + i);
        list.iter_mut().skip(start as usize).zip(set).for_each(|(entry, anchor)| *entry = anchor);
    }
    list
}
