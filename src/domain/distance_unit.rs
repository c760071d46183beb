//! The length that an anchor scene's networks are told distances in.
//!
//! Networks learn from numbers of about one to ten. Most scenes' world units give such distances by themselves; a scene whose
//! distances are in the thousands or thousandths has a unit of its own, and a file states it where it is not the usual one.

use serde::{Deserialize, Serialize};

/// Typical distances for which the world's own unit serves, in world units.
const ORDINARY: std::ops::RangeInclusive<f64> = 0.25..=64.0;

/// What the typical distance is told as in any other scene. Of 1, 2, 3 and 4 it is the one with which a scene in thousandths or
/// thousands was learnt best, and as well as in its own unit (three seeds); 4 took 0.8 to 2.7 dB.
const TYPICAL: f64 = 3.0;

/// A length in world units: positive and normal, and so is one over it.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f32", into = "f32")]
pub struct DistanceUnit(f32);

/// It is never NaN.
impl Eq for DistanceUnit {}

impl DistanceUnit {
    /// The world's unit, and that of files that state none.
    pub const USUAL: Self = Self(1.0);

    /// The unit for a scene whose cameras are typically this far from what they look at, in world units: the usual one where
    /// that is from a quarter to 64, else a third of it.
    #[must_use]
    pub fn of_typical(distance: f64) -> Self {
        if ORDINARY.contains(&distance) {
            return Self::USUAL;
        }
        Self::new((distance / TYPICAL) as f32).unwrap_or(Self::USUAL)
    }

    /// A unit of this length, which must be positive and normal, as must one over it.
    #[must_use]
    pub fn new(length: f32) -> Option<Self> {
        (length > 0.0 && length.is_normal() && length.recip().is_normal()).then_some(Self(length))
    }

    /// In world units.
    #[must_use]
    pub fn length(self) -> f32 {
        self.0
    }

    /// Whether a file need not state it.
    #[must_use]
    pub fn is_usual(&self) -> bool {
        *self == Self::USUAL
    }
}

impl Default for DistanceUnit {
    fn default() -> Self {
        Self::USUAL
    }
}

impl From<DistanceUnit> for f32 {
    fn from(unit: DistanceUnit) -> f32 {
        unit.0
    }
}

impl TryFrom<f32> for DistanceUnit {
    type Error = String;

    fn try_from(length: f32) -> Result<Self, String> {
        Self::new(length).ok_or_else(|| format!("{length} is no length that distances can be told in"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_worlds_own_in_ordinary_scenes_and_a_third_of_the_typical_distance_in_others() {
        for distance in [0.25, 1.0, 4.0, 64.0] {
            assert!(DistanceUnit::of_typical(distance).is_usual(), "{distance}");
        }
        for distance in [1e-9, 0.004, 0.2499, 64.1, 4000.0, 1e9] {
            let unit = DistanceUnit::of_typical(distance).length();
            assert!((3.0 * f64::from(unit) / distance - 1.0).abs() < 1e-7, "{distance}: {unit}");
        }
        for none in [0.0, -3.0, f64::NAN, f64::INFINITY, 1e-60, 1e60] {
            assert!(DistanceUnit::of_typical(none).is_usual(), "{none}");
        }
    }

    #[test]
    fn text_keeps_every_bit_and_what_is_no_length_is_refused() {
        let unit = DistanceUnit::new(0.000_123_456_79).expect("a length");
        let text = serde_json::to_string(&unit).expect("text");
        assert_eq!(serde_json::from_str::<DistanceUnit>(&text).expect("a length"), unit);
        // One over 3e38 is not normal: a device may take it for zero.
        for text in ["0", "-0.0", "-1", "1e-45", "3e38", "1e39", "null", "\"metre\""] {
            assert!(serde_json::from_str::<DistanceUnit>(text).is_err(), "{text}");
        }
    }
}
