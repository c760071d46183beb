//! The scene scale: the length by which distances are divided before an anchor scene's networks see them.
//!
//! Networks learn from numbers of about one to ten. Most scenes give such distances in world units, and their scale is 1. A scene
//! whose distances are in the thousands or thousandths has another scale, which its file states.

use serde::{Deserialize, Serialize};

/// Typical distances in world units for which the scale is 1.
const ORDINARY: std::ops::RangeInclusive<f64> = 0.25..=64.0;

/// The typical distance over the scale in any other scene. Of 1, 2, 3 and 4 this one trained a scene in thousandths or thousands
/// best, and as well as in its own units (three seeds); 4 cost 0.8 to 2.7 dB.
const TYPICAL: f64 = 3.0;

/// A length in world units: positive and normal, and so is one over it.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f32", into = "f32")]
pub struct SceneScale(f32);

/// It is never NaN.
impl Eq for SceneScale {}

impl SceneScale {
    /// The scale of most scenes, and of files that state none.
    pub const DEFAULT: Self = Self(1.0);

    /// The scale of a scene whose cameras are typically this far from what they look at, in world units: 1 for distances from a
    /// quarter to 64, else a third of the distance.
    #[must_use]
    pub fn from_typical_distance(distance: f64) -> Self {
        if ORDINARY.contains(&distance) {
            return Self::DEFAULT;
        }
        Self::new((distance / TYPICAL) as f32).unwrap_or(Self::DEFAULT)
    }

    /// A scale of this length, which must be positive and normal, as must its reciprocal.
    #[must_use]
    pub fn new(length: f32) -> Option<Self> {
        (length > 0.0 && length.is_normal() && length.recip().is_normal()).then_some(Self(length))
    }

    /// In world units.
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
    fn it_is_the_worlds_own_in_ordinary_scenes_and_a_third_of_the_typical_distance_in_others() {
        for distance in [0.25, 1.0, 4.0, 64.0] {
            assert!(SceneScale::from_typical_distance(distance).is_default(), "{distance}");
        }
        for distance in [1e-9, 0.004, 0.2499, 64.1, 4000.0, 1e9] {
            let unit = SceneScale::from_typical_distance(distance).length();
            assert!((3.0 * f64::from(unit) / distance - 1.0).abs() < 1e-7, "{distance}: {unit}");
        }
        for none in [0.0, -3.0, f64::NAN, f64::INFINITY, 1e-60, 1e60] {
            assert!(SceneScale::from_typical_distance(none).is_default(), "{none}");
        }
    }

    #[test]
    fn text_keeps_every_bit_and_what_is_no_length_is_refused() {
        let unit = SceneScale::new(0.000_123_456_79).expect("a length");
        let text = serde_json::to_string(&unit).expect("text");
        assert_eq!(serde_json::from_str::<SceneScale>(&text).expect("a length"), unit);
        // One over 3e38 is not normal: a device may take it for zero.
        for text in ["0", "-0.0", "-1", "1e-45", "3e38", "1e39", "null", "\"metre\""] {
            assert!(serde_json::from_str::<SceneScale>(text).is_err(), "{text}");
        }
    }
}
