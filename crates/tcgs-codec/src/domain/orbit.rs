//! A circle around what a set of cameras looks at.

use glam::{DMat3, DVec3};

use super::{Camera, CameraError, Pose};

/// Weight of the initial guess, which matters only along the axes of parallel cameras.
const GUESS_WEIGHT: f64 = 1e-3;
/// Weight of the mean upward axis against the horizontal axes: less than the cameras' accidental roll.
const MEAN_UP_WEIGHT: f64 = 0.02;
const EIGEN_STEPS: usize = 50;

/// A circle of camera positions that look at its middle axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orbit {
    /// What is looked at.
    pub center: DVec3,
    /// The axis of the circle, of length 1.
    pub up: DVec3,
    /// Unit vector from the axis to the position at turn 0, perpendicular to `up`.
    pub start: DVec3,
    /// Distance from the axis.
    pub radius: f64,
    /// How far above `center` the circle lies.
    pub height: f64,
}

impl Orbit {
    /// The circle that fits `cameras`: around the point nearest to all their axes, at their mean distance and height, with their mean up
    /// direction, starting at the first of them. `None` without cameras.
    #[must_use]
    pub fn around(cameras: &[Camera]) -> Option<Self> {
        let count = cameras.len() as f64;
        let mean = |of: &dyn Fn(&Pose) -> DVec3| {
            cameras.iter().map(|camera| of(&camera.pose)).sum::<DVec3>() / count
        };
        let first = cameras.first()?.pose.center();
        let up = upright(cameras, mean(&|pose| -pose.rotation().row(1)).normalize_or(DVec3::Z));
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
        // Cameras straight above, below or at the center define no direction, so any will do.
        let radius = if radius > 1e-6 * distance { radius } else { distance.max(1.0) };
        Some(Self { center, up, start, radius, height })
    }

    /// The same circle from further away, or nearer.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        Self { radius: self.radius * factor, height: self.height * factor, ..self }
    }

    /// The circle at the same distance from the center, at this elevation in degrees.
    #[must_use]
    pub fn at_elevation(self, degrees: f64) -> Self {
        let distance = self.radius.hypot(self.height);
        let (sin, cos) = degrees.to_radians().sin_cos();
        Self { radius: distance * cos, height: distance * sin, ..self }
    }

    /// The pose after `turns` turns, anticlockwise when seen from above.
    ///
    /// # Errors
    /// [`CameraError`] for a circle without extent.
    pub fn pose(&self, turns: f64) -> Result<Pose, CameraError> {
        let (sin, cos) = (std::f64::consts::TAU * turns.fract()).sin_cos();
        let outward = self.start * cos + self.up.cross(self.start) * sin;
        Pose::look_at(self.center + outward * self.radius + self.up * self.height, self.center, self.up)
    }
}

/// The direction most perpendicular to the cameras' horizontal axes. The mean of their upward axes is biased towards where most of
/// them are; it decides only where the horizontal axes do not, as when all are parallel.
fn upright(cameras: &[Camera], mean_up: DVec3) -> DVec3 {
    let outer = |v: DVec3| DMat3::from_cols(v * v.x, v * v.y, v * v.z);
    let mut spread = MEAN_UP_WEIGHT * (DMat3::IDENTITY - outer(mean_up));
    for camera in cameras {
        spread += outer(camera.pose.rotation().row(0)) * (1.0 / cameras.len() as f64);
    }
    // The eigenvector of the smallest value, by inverse iteration; the last term keeps the matrix regular.
    let inverse = (spread + DMat3::from_diagonal(DVec3::splat(1e-6))).inverse();
    let found = (0..EIGEN_STEPS).fold(mean_up, |up, _| (inverse * up).normalize_or(up));
    if found.dot(mean_up) < 0.0 { -found } else { found }
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
    fn cameras_that_are_mostly_on_one_side_do_not_tilt_the_circle() {
        let at = |azimuth: f64, elevation: f64| {
            let (sin, cos) = azimuth.sin_cos();
            let position = 4.0 * DVec3::new(cos * elevation.cos(), sin * elevation.cos(), elevation.sin());
            camera(position, DVec3::ZERO, DVec3::Z)
        };
        let cameras: Vec<Camera> =
            (0..20).map(|i| at(0.12 * f64::from(i), 0.3 + 0.05 * f64::from(i % 7))).collect();
        let mean_up = cameras.iter().map(|camera| -camera.pose.rotation().row(1)).sum::<DVec3>().normalize();
        let orbit = Orbit::around(&cameras).expect("cameras");
        let degrees = |up: DVec3| up.angle_between(DVec3::Z).to_degrees();
        assert!(degrees(mean_up) > 15.0, "{}", degrees(mean_up));
        assert!(degrees(orbit.up) < 1.5, "{}", degrees(orbit.up));
        // All in a row: only the mean tells up from ahead.
        let row: Vec<Camera> = (0..5)
            .map(|i| camera(DVec3::new(f64::from(i), 0.0, 1.0), DVec3::new(f64::from(i), 5.0, 0.0), DVec3::Z))
            .collect();
        let orbit = Orbit::around(&row).expect("cameras");
        assert!(degrees(orbit.up) < 15.0, "{:?}", orbit.up);
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
