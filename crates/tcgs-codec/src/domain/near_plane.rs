//! The near plane: nothing nearer to a camera is rendered.
//!
//! A fixed depth would hide all of a scene in large units, so it follows the scene's extent. A file states it unless it is the
//! default.

use serde::{Deserialize, Serialize};

/// Largest near plane as a fraction of the scene's extent.
const MAX_EXTENT_FRACTION: f32 = 0.05;

/// Depth of the near plane in units of the scene's frame: finite and positive.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f32", into = "f32")]
pub struct NearPlane(f32);

/// It is never NaN.
impl Eq for NearPlane {}

impl NearPlane {
    /// The published depth (METHOD.md §3.1), and that of files that state none.
    pub const DEFAULT: Self = Self(0.2);

    /// The near plane of a scene of this extent (its cameras' radius, in units of its frame): the default, but at most a
    /// twentieth of the extent.
    #[must_use]
    pub fn of_extent(extent: f32) -> Self {
        Self::new(Self::DEFAULT.0.min(MAX_EXTENT_FRACTION * extent)).unwrap_or(Self::DEFAULT)
    }

    /// A near plane at `depth`, which must be positive and finite.
    #[must_use]
    pub fn new(depth: f32) -> Option<Self> {
        (depth.is_normal() && depth > 0.0).then_some(Self(depth))
    }

    /// In units of the scene's frame.
    #[must_use]
    pub fn depth(self) -> f32 {
        self.0
    }

    /// Whether it is the default, which files leave out.
    #[must_use]
    pub fn is_default(&self) -> bool {
        *self == Self::DEFAULT
    }
}

impl Default for NearPlane {
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl From<NearPlane> for f32 {
    fn from(near: NearPlane) -> f32 {
        near.0
    }
}

impl TryFrom<f32> for NearPlane {
    type Error = String;

    fn try_from(depth: f32) -> Result<Self, String> {
        Self::new(depth).ok_or_else(|| format!("a near plane at {depth} is not in front of a camera"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_published_one_where_the_scene_is_large_enough() {
        for (extent, depth) in [(100.0, 0.2), (4.0, 0.2), (1.0, 0.05), (0.004, 0.000_2)] {
            let near: f32 = NearPlane::of_extent(extent).depth();
            assert!((near / depth - 1.0_f32).abs() < 1e-6, "{extent}: {near}");
        }
        for extent in [0.0, -1.0, f32::NAN] {
            assert!(NearPlane::of_extent(extent).is_default(), "{extent}");
        }
        assert!(NearPlane::of_extent(f32::INFINITY).is_default());
    }

    #[test]
    fn text_keeps_every_bit_and_what_is_no_depth_is_refused() {
        let near = NearPlane::of_extent(0.123_456_79);
        let text = serde_json::to_string(&near).expect("text");
        assert_eq!(serde_json::from_str::<NearPlane>(&text).expect("a depth"), near);
        for text in ["0", "-0.1", "1e-45", "1e39", "\"far\""] {
            assert!(serde_json::from_str::<NearPlane>(text).is_err(), "{text}");
        }
    }
}
