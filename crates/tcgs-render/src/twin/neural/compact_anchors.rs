//! The list of visible anchors.

/// The visible anchors in ascending order.
#[must_use]
pub fn compact_anchors(visible: &[bool]) -> Vec<u32> {
    (0..).zip(visible).filter(|(_, visible)| **visible).map(|(anchor, _)| anchor).collect()
}
