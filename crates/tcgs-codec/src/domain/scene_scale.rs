//! The scene scale: the length by which distances are divided before an anchor scene's networks see them.
//!
//! Networks learn from numbers of about one to ten, which distances in a scene's frame are, so scenes that are trained now have the
//! scale 1. Files of earlier versions, whose frame is the world's, may state another.

use serde::{Deserialize, Serialize};

/// A length in units of the scene's frame: positive and normal, and so is one over it.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f32", into = "f32")]
pub struct SceneScale(f32);

/// It is never NaN.
impl Eq for SceneScale {}

impl SceneScale {
    /// The scale of most scenes, and of files that state none.
    pub const DEFAULT: Self = Self(1.0);

    /// A scale of this length, which must be positive and normal, as must its reciprocal.
    #[must_use]
    pub fn new(length: f32) -> Option<Self> {
        (length > 0.0 && length.is_normal() && length.recip().is_normal()).then_some(Self(length))
    }

    /// In units of the scene's frame.
    #[must_use]
    pub fn length(self) -> f32 {
        self.0
    }

    /// Whether it is the default, which files leave out.
    #[must_use]
    pub fn is_default(&self) -> bool {
        *self == Self::DEFAULT
    }
}

impl Default for SceneScale {
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl From<SceneScale> for f32 {
    fn from(scale: SceneScale) -> f32 {
        scale.0
    }
}

impl TryFrom<f32> for SceneScale {
    type Error = String;

    fn try_from(length: f32) -> Result<Self, String> {
        Self::new(length).ok_or_else(|| {
            format!("{length} is not a scene scale: it and its reciprocal must be positive and normal")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_keeps_every_bit_and_what_is_no_length_is_refused() {
        let unit = SceneScale::new(0.000_123_456_79).expect("a length");
        let text = serde_json::to_string(&unit).expect("text");
        assert_eq!(serde_json::from_str::<SceneScale>(&text).expect("a length"), unit);
        // One over 3e38 is not normal: a device may take it for zero.
        for text in ["0", "-0.0", "-1", "1e-45", "3e38", "1e39", "null", "\"meter\""] {
            assert!(serde_json::from_str::<SceneScale>(text).is_err(), "{text}");
        }
    }
}
