//! How an exported scene is turned and scaled, for programs with another upward axis or another unit.

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};
use tcgs_codec::named_choice;
use thiserror::Error;

use super::{Camera, Orbit, Pose};

/// The largest factor of lengths, and the inverse of the smallest.
pub const MAX_SCALE: f64 = 1e6;

named_choice! {
    /// The axis that points up.
    pub enum UpAxis {
        /// The first axis.
        X = "x",
        /// The second axis.
        Y = "y",
        /// The third axis.
        Z = "z",
        /// Against the first axis.
        NegativeX = "-x",
        /// Against the second axis, as in many photo sets.
        NegativeY = "-y",
        /// Against the third axis.
        NegativeZ = "-z",
    }
}

impl UpAxis {
    /// The unit vector.
    #[must_use]
    pub fn direction(self) -> DVec3 {
        match self {
            Self::X => DVec3::X,
            Self::Y => DVec3::Y,
            Self::Z => DVec3::Z,
            Self::NegativeX => DVec3::NEG_X,
            Self::NegativeY => DVec3::NEG_Y,
            Self::NegativeZ => DVec3::NEG_Z,
        }
    }
}

/// Why a scene cannot be placed.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PlacementError {
    /// The upward direction comes from cameras, and there are none.
    #[error("up: the scene's upward direction is that of its cameras, and there are none")]
    NoCameras,
    /// The factor is out of range.
    #[error("scale: {0} is not a number from {min} to {MAX_SCALE}", min = 1.0 / MAX_SCALE)]
    Scale(f64),
}

/// What an exported scene's coordinates shall be.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Placement {
    /// The axis that the scene's upward direction becomes; turned not at all without one.
    pub up: Option<UpAxis>,
    /// The factor of lengths.
    pub scale: f64,
}

impl Default for Placement {
    fn default() -> Self {
        Self { up: None, scale: 1.0 }
    }
}

impl Placement {
    /// Whether nothing changes.
    #[must_use]
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Checks the range of the factor.
    ///
    /// # Errors
    /// [`PlacementError::Scale`].
    pub fn validated(self) -> Result<Self, PlacementError> {
        let is_possible = (1.0 / MAX_SCALE..=MAX_SCALE).contains(&self.scale);
        if is_possible { Ok(self) } else { Err(PlacementError::Scale(self.scale)) }
    }

    /// The transformation of a scene whose upward direction is that of `cameras`, as an orbit around it has it: the smallest rotation
    /// that turns it to the axis, then the factor, both about the world's origin.
    ///
    /// # Errors
    /// [`PlacementError`].
    pub fn similarity(self, cameras: &[Camera]) -> Result<Similarity, PlacementError> {
        let Self { up, scale } = self.validated()?;
        let rotation = match up {
            None => DQuat::IDENTITY,
            Some(axis) => {
                let orbit = Orbit::around(cameras).ok_or(PlacementError::NoCameras)?;
                DQuat::from_rotation_arc(orbit.up.normalize(), axis.direction())
            }
        };
        Ok(Similarity { rotation, scale })
    }
}

/// A rotation about the world's origin, then a factor of lengths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    rotation: DQuat,
    scale: f64,
}

impl Similarity {
    /// Which changes nothing.
    pub const NONE: Self = Self { rotation: DQuat::IDENTITY, scale: 1.0 };

    /// The rotation.
    #[must_use]
    pub fn rotation(&self) -> DQuat {
        self.rotation
    }

    /// The factor of lengths.
    #[must_use]
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// Where a point goes.
    #[must_use]
    pub fn point(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point)
    }

    /// The camera that sees the transformed scene as `camera` sees the scene.
    #[must_use]
    pub fn camera(&self, camera: &Camera) -> Camera {
        if *self == Self::NONE {
            return *camera;
        }
        let rotation = camera.pose.rotation() * DMat3::from_quat(self.rotation.conjugate());
        let translation = self.scale * camera.pose.translation();
        let pose = Pose::from_world_to_camera(rotation, translation).unwrap_or(camera.pose);
        Camera { pose, ..*camera }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Intrinsics;

    /// Cameras around the origin, upright about `up`.
    fn cameras(up: DVec3) -> Vec<Camera> {
        let (right, ahead) = (up.any_orthonormal_vector(), up.cross(up.any_orthonormal_vector()));
        let camera = |index: u32| {
            let (sin, cos) = (std::f64::consts::TAU / 8.0 * f64::from(index)).sin_cos();
            let position = 3.0 * (cos * right + sin * ahead) + up;
            let intrinsics = Intrinsics::from_horizontal_fov(1.0, 40, 30).expect("intrinsics");
            let pose = Pose::look_at(position, DVec3::ZERO, up).expect("a view");
            Camera::new(intrinsics, pose).expect("a camera")
        };
        (0..8).map(camera).collect()
    }

    #[test]
    fn the_scenes_upward_direction_becomes_any_axis() {
        for up in [DVec3::Z, DVec3::NEG_Y, DVec3::new(1.0, -2.0, 0.5).normalize()] {
            let cameras = cameras(up);
            for axis in UpAxis::ALL {
                let placement = Placement { up: Some(axis), scale: 0.01 };
                let similarity = placement.similarity(&cameras).expect("cameras");
                let turned = similarity.point(up) / 0.01;
                assert!(turned.distance(axis.direction()) < 1e-6, "{up} to {axis}: {turned}");
            }
        }
    }

    #[test]
    fn a_transformed_camera_sees_a_transformed_point_where_it_was() {
        let cameras = cameras(DVec3::new(1.0, -2.0, 0.5).normalize());
        let placement = Placement { up: Some(UpAxis::Y), scale: 2.5 };
        let similarity = placement.similarity(&cameras).expect("cameras");
        for point in [DVec3::new(0.3, 0.2, -0.1), DVec3::new(-0.5, 0.1, 0.4)] {
            for camera in &cameras {
                let (before, depth) = camera.project(point).expect("ahead");
                let (after, deeper) =
                    similarity.camera(camera).project(similarity.point(point)).expect("ahead");
                assert!(before.distance(after) < 1e-9, "{before} {after}");
                assert!((2.5 * depth - deeper).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn what_cannot_be_is_refused_and_nothing_changes_nothing() {
        for scale in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e-7, 1e7] {
            let error = Placement { scale, ..Placement::default() }.similarity(&[]).expect_err("no factor");
            assert!(error.to_string().starts_with("scale: "), "{error}");
        }
        let up = Placement { up: Some(UpAxis::Z), ..Placement::default() };
        assert_eq!(up.similarity(&[]), Err(PlacementError::NoCameras));
        assert_eq!(Placement::default().similarity(&[]), Ok(Similarity::NONE));
        assert!(Placement::default().is_none() && !up.is_none());
    }
}
