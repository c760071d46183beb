//! How the render networks see the direction of view: as a unit vector alone, or with spherical harmonics of higher degrees beside it.
//!
//! A network of rectifying units bends its outputs along planes of its inputs. With the vector alone those are halves of the sphere of
//! directions; harmonics add lobes, as plain Gaussians have them.

use glam::DVec3;

use super::harmonics;

/// The highest degree of the direction's spherical harmonics among the networks' inputs: 1 to 3.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct ViewDegree(u8);

impl ViewDegree {
    /// The direction alone, as published, and as in files that state no degree.
    pub const DEFAULT: Self = Self(1);
    /// The highest degree.
    pub const MAX: Self = Self(3);
    /// Every degree.
    pub const ALL: [Self; 3] = [Self::DEFAULT, Self(2), Self::MAX];

    /// This degree, if it is one of [`Self::ALL`].
    #[must_use]
    pub fn new(degree: u8) -> Option<Self> {
        (1..=3).contains(&degree).then_some(Self(degree))
    }

    /// The degree of networks with so many inputs besides the feature.
    #[must_use]
    pub fn of_inputs(inputs: usize) -> Option<Self> {
        Self::ALL.into_iter().find(|degree| degree.inputs() == inputs)
    }

    /// As a number.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0
    }

    /// Inputs besides the feature: the unit view direction (3), the distance in the scene's [`SceneScale`](super::SceneScale) (1), five
    /// harmonics of degree 2 and seven of degree 3.
    #[must_use]
    pub const fn inputs(self) -> usize {
        (self.0 as usize + 1).pow(2)
    }

    /// Whether it is the default, which files leave out.
    #[must_use]
    pub fn is_default(self) -> bool {
        self == Self::DEFAULT
    }

    /// The inputs after the distance: [`harmonics::basis`] from degree 2 on at the unit vector `direction`, scaled so that the squares
    /// of a degree sum to one, as those of the direction do.
    pub fn harmonics(self, direction: DVec3) -> impl Iterator<Item = f64> {
        let basis = harmonics::basis(direction);
        (harmonics::functions(1)..harmonics::functions(self.0)).map(move |function| {
            let size = 1.0 + 2.0 * f64::from(harmonics::degree_of(function));
            (2.0 * std::f64::consts::TAU / size).sqrt() * basis[function]
        })
    }
}

impl Default for ViewDegree {
    fn default() -> Self {
        Self::DEFAULT
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inputs_tell_the_degree() {
        assert_eq!(ViewDegree::ALL.map(ViewDegree::inputs), [4, 9, 16]);
        assert_eq!(
            ViewDegree::ALL.map(|degree| ViewDegree::of_inputs(degree.inputs())),
            ViewDegree::ALL.map(Some)
        );
        assert_eq!([0, 3, 5, 25].map(ViewDegree::of_inputs), [None; 4]);
        assert_eq!(ViewDegree::ALL.map(|degree| ViewDegree::new(degree.get())), ViewDegree::ALL.map(Some));
        assert_eq!([0, 4].map(ViewDegree::new), [None; 2]);
    }

    #[test]
    fn the_squares_of_a_degree_sum_to_one() {
        for direction in [DVec3::X, DVec3::new(0.6, 0.0, -0.8), DVec3::new(-2.0, 3.0, 6.0) / 7.0] {
            let values: Vec<f64> = ViewDegree::MAX.harmonics(direction).collect();
            assert_eq!(values.len(), 12);
            for degree in [&values[..5], &values[5..]] {
                let sum: f64 = degree.iter().map(|value| value * value).sum();
                assert!((sum - 1.0).abs() < 1e-12, "{sum} at {direction}");
            }
            assert_eq!(ViewDegree::ALL[1].harmonics(direction).collect::<Vec<_>>(), values[..5]);
            assert_eq!(ViewDegree::DEFAULT.harmonics(direction).count(), 0);
        }
    }
}
