//! The widths of a scene that all sections share.

pub(super) use crate::domain::AttributeGroup as Attribute;
use crate::domain::anchors::SCALINGS_PER_ANCHOR;

/// The widths of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SceneShape {
    pub(super) anchors: usize,
    pub(super) feature_dim: usize,
    pub(super) offsets_per_anchor: usize,
}

impl SceneShape {
    /// Channels of an attribute.
    pub(super) fn channels(self, attribute: Attribute) -> usize {
        match attribute {
            Attribute::Features => self.feature_dim,
            Attribute::Scalings => SCALINGS_PER_ANCHOR,
            Attribute::Offsets => 3 * self.offsets_per_anchor,
        }
    }
}
