//! A circle around what a set of cameras looks at.

use glam::{DMat3, DVec3};

use super::{Camera, CameraError, Pose};

/// Weight of the guess that decides where the cameras' axes do not: along the axes of parallel cameras.
const GUESS_WEIGHT: f64 = 1e-3;

/// A circle of camera positions that look at its middle axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orbit {
    /// What is looked at.
    pub center: DVec3,
    /// The axis of the circle, of length 1.
    pub up: DVec3,
    /// From the axis to the place of turn 0, of length 1 and at right angles to `up`.
    pub start: DVec3,
    /// Distance from the axis.
    pub radius: f64,
    /// How far above `center` the circle lies.
    pub height: f64,
}

impl Orbit {
    /// The circle that `cameras` lie on as well as they lie on any: around the point nearest to all their axes, at their mean
    /// distance and height, with their mean upward direction, from where the first of them is. None without cameras.
    #[must_use]
    pub fn around(cameras: &[Camera]) -> Option<Self> {
        let count = cameras.len() as f64;
        let mean = |of: &dyn Fn(&Pose) -> DVec3| {
            cameras.iter().map(|camera| of(&camera.pose)).sum::<DVec3>() / count
        };
        let first = cameras.first()?.pose.center();
        let up = mean(&|pose| -pose.rotation().row(1)).normalize_or(DVec3::Z);
        let middle = mean(&Pose::center);
        let ahead = mean(&|pose| pose.rotation().row(2));
        let spread = cameras.iter().map(|camera| camera.pose.center().distance(middle)).sum::<f64>() / count;
        let guess = middle + ahead * if spread > 0.0 { 3.0 * spread } else { 1.0 };

        // The least squares of the distances to the axes, and a little of that to the guess.
        let mut matrix = DMat3::from_diagonal(DVec3::splat(GUESS_WEIGHT * count));
        let mut right = GUESS_WEIGHT * count * guess;
        for camera in cameras {
            let axis = camera.pose.rotation().row(2);
            let across = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
            matrix += across;
            right += across * camera.pose.center();
        }
        let center = matrix.inverse() * right;

        let flat = |point: DVec3| (point - center).reject_from_normalized(up);
        let radius = cameras.iter().map(|camera| flat(camera.pose.center()).length()).sum::<f64>() / count;
        let height = mean(&|pose| DVec3::splat((pose.center() - center).dot(up))).x;
        let distance = radius.hypot(height);
        let start = flat(first).try_normalize().unwrap_or_else(|| up.any_orthonormal_vector());
        // Cameras straight above or below, or in the middle, lie on no circle; any will do then.
        let radius = if radius > 1e-6 * distance { radius } else { distance.max(1.0) };
        Some(Self { center, up, start, radius, height })
    }

    /// The same circle from further away, or nearer.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        Self { radius: self.radius * factor, height: self.height * factor, ..self }
    }

    /// The circle at the same distance from the center that is seen from it at so many degrees above the horizon.
    #[must_use]
    pub fn at_elevation(self, degrees: f64) -> Self {
        let distance = self.radius.hypot(self.height);
        let (sin, cos) = degrees.to_radians().sin_cos();
        Self { radius: distance * cos, height: distance * sin, ..self }
    }

    /// The pose after so many turns, anticlockwise when seen from above.
    ///
    /// # Errors
    /// [`CameraError`] for a circle without extent.
    pub fn pose(&self, turns: f64) -> Result<Pose, CameraError> {
        let (sin, cos) = (std::f64::consts::TAU * turns.fract()).sin_cos();
        let outward = self.start * cos + self.up.cross(self.start) * sin;
        Pose::look_at(self.center + outward * self.radius + self.up * self.height, self.center, self.up)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Intrinsics;

    fn camera(position: DVec3, target: DVec3, up: DVec3) -> Camera {
        let intrinsics = Intrinsics { fx: 50.0, fy: 50.0, cx: 20.0, cy: 15.0, width: 40, height: 30 };
        Camera::new(intrinsics, Pose::look_at(position, target, up).expect("a view")).expect("a camera")
    }

    #[test]
    fn cameras_on_a_circle_give_that_circle() {
        let target = DVec3::new(5.0, -2.0, 1.0);
        for up in [DVec3::Z, DVec3::NEG_Y, DVec3::new(1.0, 2.0, 3.0).normalize()] {
            let truth =
                Orbit { center: target, up, start: up.any_orthonormal_vector(), radius: 3.0, height: 1.5 };
            let cameras: Vec<Camera> = (0..12)
                .map(|index| {
                    let pose = truth.pose(f64::from(index) / 12.0).expect("a pose");
                    camera(pose.center(), target, up)
                })
                .collect();
            let found = Orbit::around(&cameras).expect("cameras");
            // The guess that parallel cameras need moves the center by about its weight.
            assert!(found.center.distance(target) < 0.02, "{found:?}");
            assert!(found.up.distance(up) < 1e-9, "{found:?}");
            assert!((found.radius - 3.0).abs() < 0.02 && (found.height - 1.5).abs() < 0.02, "{found:?}");
            let first = found.pose(0.0).expect("a pose");
            assert!(
                first.center().distance(cameras[0].pose.center()) < 0.05,
                "it begins at the first camera"
            );
            let low = found.at_elevation(0.0).scaled(2.0);
            assert!((low.radius - 2.0 * 3.0_f64.hypot(1.5)).abs() < 0.1 && low.height.abs() < 1e-9);
        }
    }

    #[test]
    fn any_cameras_give_poses() {
        assert_eq!(Orbit::around(&[]), None);
        let one = camera(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DVec3::Z);
        let above = camera(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO, DVec3::X);
        let aside = |x: f64| camera(DVec3::new(x, 0.0, 0.0), DVec3::new(x, 0.0, 5.0), DVec3::Y);
        let outward = |x: f64| camera(DVec3::ZERO, DVec3::new(x, 1.0, 0.0), DVec3::Z);
        for cameras in [
            vec![one],
            vec![above],
            vec![aside(-1.0), aside(0.0), aside(1.0)],
            vec![one; 3],
            vec![outward(1.0), outward(-1.0), outward(0.2)],
        ] {
            let orbit = Orbit::around(&cameras).expect("cameras");
            for turn in 0..7 {
                let pose = orbit.pose(f64::from(turn) / 7.0).expect("a pose");
                assert!(pose.center().is_finite() && pose.center() != orbit.center, "{orbit:?}");
            }
        }
    }
}
