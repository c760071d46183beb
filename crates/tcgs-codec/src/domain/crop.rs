//! The region of the world that a finished scene keeps, as an option states it.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error as _};
use thiserror::Error;

/// The region that a scene keeps: the Gaussians whose centers lie in it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Crop {
    /// Everything.
    #[default]
    None,
    /// What at least half of the training cameras have in view.
    Cameras,
    /// A box in the dataset's world: its least and its greatest corner, if [`Crop::check`] permits them.
    Box([f64; 3], [f64; 3]),
}

/// Why a box is no region.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum CropError {
    /// A coordinate is NaN or infinite.
    #[error("{0} is not a coordinate")]
    NotFinite(f64),
    /// Nothing fits between the corners.
    #[error(
        "the box is empty along {axis}: {from} is not less than {to}; its least corner comes first, x0,y0,z0,x1,y1,z1"
    )]
    Empty {
        /// The axis.
        axis: char,
        /// Its least coordinate.
        from: f64,
        /// Its greatest coordinate.
        to: f64,
    },
}

impl Crop {
    /// Whether everything is kept.
    #[must_use]
    pub fn is_none(&self) -> bool {
        *self == Self::None
    }

    /// Checks that something fits into the region.
    ///
    /// # Errors
    /// [`CropError`], which names the first coordinate that does not fit.
    pub fn check(&self) -> Result<(), CropError> {
        let Self::Box(least, greatest) = self else { return Ok(()) };
        if let Some(value) = least.iter().chain(greatest).find(|value| !value.is_finite()) {
            return Err(CropError::NotFinite(*value));
        }
        for ((axis, from), to) in ['x', 'y', 'z'].into_iter().zip(*least).zip(*greatest) {
            if from >= to {
                return Err(CropError::Empty { axis, from, to });
            }
        }
        Ok(())
    }
}

impl fmt::Display for Crop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::None => f.write_str("none"),
            Self::Cameras => f.write_str("cameras"),
            Self::Box([x0, y0, z0], [x1, y1, z1]) => write!(f, "{x0},{y0},{z0},{x1},{y1},{z1}"),
        }
    }
}

impl FromStr for Crop {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("'{text}' is not none, cameras or a box x0,y0,z0,x1,y1,z1");
        match text {
            "none" => Ok(Self::None),
            "cameras" => Ok(Self::Cameras),
            _ => {
                let numbers: Option<Vec<f64>> =
                    text.split(',').map(|number| number.trim().parse().ok()).collect();
                match numbers.as_deref() {
                    Some(&[x0, y0, z0, x1, y1, z1]) => Ok(Self::Box([x0, y0, z0], [x1, y1, z1])),
                    _ => Err(wrong()),
                }
            }
        }
    }
}

impl Serialize for Crop {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Crop {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(D::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_are_names_or_boxes() {
        for (text, crop) in [
            ("none", Crop::None),
            ("cameras", Crop::Cameras),
            ("-1,0.1,-3e2,1,2,3", Crop::Box([-1.0, 0.1, -300.0], [1.0, 2.0, 3.0])),
        ] {
            assert_eq!(text.parse(), Ok(crop));
            let json = serde_json::to_string(&crop).expect("JSON");
            assert_eq!(serde_json::from_str::<Crop>(&json).expect("a region"), crop);
            assert_eq!(crop.check(), Ok(()));
        }
        for text in ["", "all", "1,2,3,4,5", "1,2,3,4,5,6,7", "1,2,3,4,5,", "1 2 3 4 5 6"] {
            assert!(text.parse::<Crop>().is_err(), "{text}");
        }
    }

    #[test]
    fn a_box_that_is_empty_or_no_box_is_refused_with_the_axis_or_the_number() {
        let refused = |text: &str| {
            text.parse::<Crop>().expect("six numbers").check().expect_err("no region").to_string()
        };
        assert!(refused("0,0,0,1,-1,1").starts_with("the box is empty along y: 0 is not less than -1"));
        assert!(refused("0,0,2,1,1,2").starts_with("the box is empty along z: 2 is not less than 2"));
        assert_eq!(refused("0,0,0,1,nan,1"), "NaN is not a coordinate");
        assert_eq!(refused("-inf,0,0,1,1,1"), "-inf is not a coordinate");
    }
}
