//! The visible anchors of each block.

use crate::gpu::BLOCK;

/// How many anchors of each block are visible.
#[must_use]
pub fn count_visible_anchors(visible: &[bool]) -> Vec<u32> {
    visible.chunks(BLOCK).map(|block| block.iter().filter(|flag| **flag).count() as u32).collect()
}
