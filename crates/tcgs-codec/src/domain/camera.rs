//! Pinhole cameras in OpenCV axes (x right, y down, z forward), pixel centers at +0.5, principal point honored.
//!
//! A [`Camera`] that exists is finite, has positive focal lengths and a non-empty image, and its pose is a
//! rigid motion; the constructors hold that.

use glam::{DMat3, DMat4, DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Largest image side that any part of the program accepts, in pixels.
pub const MAX_IMAGE_SIDE: u32 = 16_384;

/// Largest deviation from orthonormality that is repaired instead of refused (files store poses as decimals).
const RIGIDITY_TOLERANCE: f64 = 1e-3;

/// What can be wrong with a camera.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum CameraError {
    /// A pose entry is NaN or infinite.
    #[error("the pose has a non-finite entry")]
    NonFinitePose,
    /// The rotation part is not a rotation: scaled, sheared, mirrored or singular.
    #[error(
        "the pose is not rigid: its rotation differs from an orthonormal right-handed one by {deviation:.3e}"
    )]
    NonRigidPose {
        /// Largest absolute entry of `R Rᵀ - I`, or 2 for a mirrored rotation.
        deviation: f64,
    },
    /// A quaternion that is no rotation.
    #[error("the rotation quaternion has length {0} and so no direction")]
    NoRotation(f64),
    /// The fourth row of a 4x4 pose is not (0, 0, 0, 1).
    #[error("the last row of the pose is not 0 0 0 1")]
    NotAffine,
    /// A focal length is zero, negative or not finite.
    #[error("the focal length is {0}; it must be a positive number of pixels")]
    FocalLength(f64),
    /// The principal point is not finite.
    #[error("the principal point is not finite")]
    PrincipalPoint,
    /// The image has no pixels or more than the program accepts on a side.
    #[error("the image size {width}x{height} is outside 1..={MAX_IMAGE_SIDE} pixels per side")]
    ImageSize {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// `look_at` was given a direction that is zero or parallel to `up`.
    #[error("position, look_at and up do not span a view: {0}")]
    DegenerateView(&'static str),
}

/// Which axes a camera-to-world matrix uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "lowercase")]
pub enum Convention {
    /// x right, y down, z forward.
    #[default]
    Opencv,
    /// x right, y up, z backward (Blender, NeRF, nerfstudio).
    Opengl,
}

/// A rigid motion from world to camera coordinates, OpenCV axes: `x_camera = rotation * x_world + translation`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    rotation: DMat3,
    translation: DVec3,
}

impl Pose {
    /// A camera at the world's origin that looks along its z axis.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// A pose from a world-to-camera rotation and translation in OpenCV axes.
    ///
    /// # Errors
    /// [`CameraError::NonFinitePose`] or [`CameraError::NonRigidPose`].
    pub fn from_world_to_camera(rotation: DMat3, translation: DVec3) -> Result<Self, CameraError> {
        if !rotation.is_finite() || !translation.is_finite() {
            return Err(CameraError::NonFinitePose);
        }
        let gram = rotation * rotation.transpose() - DMat3::IDENTITY;
        let mut deviation = gram.to_cols_array().iter().fold(0.0_f64, |worst, v| worst.max(v.abs()));
        if rotation.determinant() < 0.0 {
            deviation = deviation.max(2.0);
        }
        if deviation > RIGIDITY_TOLERANCE {
            return Err(CameraError::NonRigidPose { deviation });
        }
        let rotation = DMat3::from_quat(DQuat::from_mat3(&rotation).normalize());
        Ok(Self { rotation, translation })
    }

    /// A pose whose rotation is one of another pose, bit for bit.
    pub(super) fn of_rigid(rotation: DMat3, translation: DVec3) -> Self {
        Self { rotation, translation }
    }

    /// A pose from a camera-to-world matrix whose camera axes follow `convention`.
    ///
    /// # Errors
    /// [`CameraError::NotAffine`], [`CameraError::NonFinitePose`] or [`CameraError::NonRigidPose`].
    pub fn from_camera_to_world(matrix: DMat4, convention: Convention) -> Result<Self, CameraError> {
        if !matrix.is_finite() {
            return Err(CameraError::NonFinitePose);
        }
        let last_row = matrix.row(3);
        if (last_row - glam::DVec4::W).abs().max_element() > 1e-9 {
            return Err(CameraError::NotAffine);
        }
        let mut axes = DMat3::from_mat4(matrix);
        if convention == Convention::Opengl {
            axes.y_axis = -axes.y_axis;
            axes.z_axis = -axes.z_axis;
        }
        let position = matrix.w_axis.truncate();
        let rotation = axes.transpose();
        Self::from_world_to_camera(rotation, -(rotation * position))
    }

    /// A pose at `position` that looks at `target`, with `up` towards the top of the image.
    ///
    /// # Errors
    /// [`CameraError::DegenerateView`] if the three do not span a plane, [`CameraError::NonFinitePose`].
    pub fn look_at(position: DVec3, target: DVec3, up: DVec3) -> Result<Self, CameraError> {
        if !(position.is_finite() && target.is_finite() && up.is_finite()) {
            return Err(CameraError::NonFinitePose);
        }
        let forward = (target - position)
            .try_normalize()
            .ok_or(CameraError::DegenerateView("look_at equals position"))?;
        let right = forward
            .cross(up)
            .try_normalize()
            .filter(|_| forward.cross(up).length() > 1e-9 * up.length())
            .ok_or(CameraError::DegenerateView("up is zero or parallel to the view direction"))?;
        let down = forward.cross(right);
        let rotation = DMat3::from_cols(right, down, forward).transpose();
        Self::from_world_to_camera(rotation, -(rotation * position))
    }

    /// World-to-camera rotation.
    #[must_use]
    pub fn rotation(&self) -> DMat3 {
        self.rotation
    }

    /// World-to-camera translation.
    #[must_use]
    pub fn translation(&self) -> DVec3 {
        self.translation
    }

    /// The camera center in world coordinates.
    #[must_use]
    pub fn center(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// The 4x4 camera-to-world matrix with camera axes as `convention` has them.
    #[must_use]
    pub fn camera_to_world(&self, convention: Convention) -> DMat4 {
        let mut axes = self.rotation.transpose();
        if convention == Convention::Opengl {
            axes.y_axis = -axes.y_axis;
            axes.z_axis = -axes.z_axis;
        }
        DMat4::from_cols(
            axes.x_axis.extend(0.0),
            axes.y_axis.extend(0.0),
            axes.z_axis.extend(0.0),
            self.center().extend(1.0),
        )
    }
}

/// Pinhole intrinsics in pixels; the center of the top-left pixel is at (0.5, 0.5).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Horizontal focal length.
    pub fx: f64,
    /// Vertical focal length.
    pub fy: f64,
    /// Principal point, horizontal.
    pub cx: f64,
    /// Principal point, vertical.
    pub cy: f64,
    /// Image width.
    pub width: u32,
    /// Image height.
    pub height: u32,
}

impl Intrinsics {
    /// Checks that the values describe a camera.
    ///
    /// # Errors
    /// [`CameraError::FocalLength`], [`CameraError::PrincipalPoint`] or [`CameraError::ImageSize`].
    pub fn validated(self) -> Result<Self, CameraError> {
        for focal in [self.fx, self.fy] {
            if !(focal.is_finite() && focal > 0.0) {
                return Err(CameraError::FocalLength(focal));
            }
        }
        if !(self.cx.is_finite() && self.cy.is_finite()) {
            return Err(CameraError::PrincipalPoint);
        }
        let sides = 1..=MAX_IMAGE_SIDE;
        if !sides.contains(&self.width) || !sides.contains(&self.height) {
            return Err(CameraError::ImageSize { width: self.width, height: self.height });
        }
        Ok(self)
    }

    /// The same view in a picture of other sides. Pixel centers lie at +0.5, so everything scales by plain factors.
    #[must_use]
    pub fn resized(self, width: u32, height: u32) -> Self {
        let x = f64::from(width) / f64::from(self.width);
        let y = f64::from(height) / f64::from(self.height);
        Self { fx: self.fx * x, fy: self.fy * y, cx: self.cx * x, cy: self.cy * y, width, height }
    }

    /// Intrinsics of a centered camera with square pixels from its horizontal field of view in radians.
    ///
    /// # Errors
    /// As [`Intrinsics::validated`]; a field of view outside (0, pi) gives a focal length that is refused.
    pub fn from_horizontal_fov(fov: f64, width: u32, height: u32) -> Result<Self, CameraError> {
        let focal = if fov > 0.0 && fov < std::f64::consts::PI {
            f64::from(width) / (2.0 * (fov / 2.0).tan())
        } else {
            0.0
        };
        let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
        Self { fx: focal, fy: focal, cx, cy, width, height }.validated()
    }
}

/// A posed pinhole camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Pinhole intrinsics.
    pub intrinsics: Intrinsics,
    /// World-to-camera motion.
    pub pose: Pose,
}

impl Camera {
    /// A camera from checked parts.
    ///
    /// # Errors
    /// As [`Intrinsics::validated`].
    pub fn new(intrinsics: Intrinsics, pose: Pose) -> Result<Self, CameraError> {
        Ok(Self { intrinsics: intrinsics.validated()?, pose })
    }

    /// The same view with sides of at most `side` pixels, and at least one.
    #[must_use]
    pub fn within(&self, side: u32) -> Self {
        let Intrinsics { width, height, .. } = self.intrinsics;
        let longer = width.max(height).max(side);
        let shrunk = |length: u32| (u64::from(length) * u64::from(side) / u64::from(longer)).max(1) as u32;
        Self { intrinsics: self.intrinsics.resized(shrunk(width), shrunk(height)), pose: self.pose }
    }

    /// Pixel coordinates and depth of a world point, or `None` at or behind the camera plane.
    #[must_use]
    pub fn project(&self, point: DVec3) -> Option<(DVec2, f64)> {
        let p = self.pose.rotation() * point + self.pose.translation();
        let k = &self.intrinsics;
        (p.z > 0.0).then(|| (DVec2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy), p.z))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_conventions_describe_the_same_camera() {
        let pose = Pose::look_at(DVec3::new(3.0, -2.0, 1.5), DVec3::ZERO, DVec3::Z).expect("a view");
        for convention in [Convention::Opencv, Convention::Opengl] {
            let back =
                Pose::from_camera_to_world(pose.camera_to_world(convention), convention).expect("a pose");
            assert!((back.rotation() - pose.rotation()).to_cols_array().iter().all(|v| v.abs() < 1e-12));
            assert!((back.center() - pose.center()).length() < 1e-12, "{convention:?}");
        }
    }

    #[test]
    fn the_view_target_projects_to_the_principal_point_and_up_is_up() {
        let pose = Pose::look_at(DVec3::new(4.0, 0.0, 1.0), DVec3::ZERO, DVec3::Z).expect("a view");
        let intrinsics = Intrinsics { fx: 100.0, fy: 110.0, cx: 31.0, cy: 20.0, width: 64, height: 48 };
        let camera = Camera::new(intrinsics, pose).expect("a camera");
        let (center, depth) = camera.project(DVec3::ZERO).expect("in front");
        assert!((center - DVec2::new(31.0, 20.0)).length() < 1e-9);
        assert!((depth - 17.0_f64.sqrt()).abs() < 1e-12);
        let (above, _) = camera.project(DVec3::Z * 0.1).expect("in front");
        assert!(above.y < center.y, "a point above the target must appear higher in the image");
    }

    #[test]
    fn impossible_poses_and_intrinsics_are_refused() {
        let nan = DMat4::from_cols_array(&[f64::NAN; 16]);
        assert_eq!(Pose::from_camera_to_world(nan, Convention::Opencv), Err(CameraError::NonFinitePose));
        let scaled = DMat4::from_scale(DVec3::splat(2.0));
        assert!(matches!(
            Pose::from_camera_to_world(scaled, Convention::Opencv),
            Err(CameraError::NonRigidPose { .. })
        ));
        let mirrored = DMat4::from_scale(DVec3::new(-1.0, 1.0, 1.0));
        assert!(matches!(
            Pose::from_camera_to_world(mirrored, Convention::Opencv),
            Err(CameraError::NonRigidPose { .. })
        ));
        assert!(Pose::look_at(DVec3::ONE, DVec3::ONE, DVec3::Z).is_err());
        assert!(Pose::look_at(DVec3::ZERO, DVec3::Z, DVec3::Z).is_err());
        let zero_focal = Intrinsics { fx: 0.0, fy: 1.0, cx: 0.0, cy: 0.0, width: 4, height: 4 };
        assert_eq!(zero_focal.validated(), Err(CameraError::FocalLength(0.0)));
        assert!(Intrinsics::from_horizontal_fov(4.0, 8, 8).is_err());
    }
}
