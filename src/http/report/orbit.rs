//! The first view of the page's viewer and the point that it orbits.

use glam::{DMat3, DVec3};

use crate::domain::{Camera, NamedCamera};

/// The viewer's first view: a camera that looks at `center`, and what is up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Orbit {
    pub(super) position: DVec3,
    pub(super) center: DVec3,
    pub(super) up: DVec3,
    /// Horizontal field of view in degrees.
    pub(super) fov: f64,
    /// Width by height.
    pub(super) aspect: f64,
}

impl Orbit {
    /// The view of the first held-out camera, or of the first there is, turned about what the cameras look at.
    pub(super) fn of(cameras: &[NamedCamera]) -> Option<Self> {
        let first = NamedCamera::first_to_show(cameras)?;
        let Camera { intrinsics, pose } = first.camera;
        let position = pose.center();
        let up = cameras.iter().map(|camera| axis(&camera.camera, -DVec3::Y)).sum::<DVec3>();
        let up = up.try_normalize().unwrap_or_else(|| axis(&first.camera, -DVec3::Y));
        let center = focus(cameras, position, axis(&first.camera, DVec3::Z));
        let fov = 2.0 * (f64::from(intrinsics.width) / (2.0 * intrinsics.fx)).atan();
        let aspect = f64::from(intrinsics.width) / f64::from(intrinsics.height);
        Some(Self { position, center, up, fov: fov.to_degrees().clamp(10.0, 120.0), aspect })
    }
}

/// A direction of the camera in the world.
fn axis(camera: &Camera, direction: DVec3) -> DVec3 {
    camera.pose.rotation().transpose() * direction
}

/// A point ahead of the first camera: as far along its axis as the point that is nearest to all axes in the sense of least
/// squares, so that the viewer opens with that camera's own view. Cameras that look the same way have no such point, and then
/// it is a distance that suits how far apart they stand.
fn focus(cameras: &[NamedCamera], position: DVec3, ahead: DVec3) -> DVec3 {
    let (mut matrix, mut moment) = (DMat3::ZERO, DVec3::ZERO);
    for NamedCamera { camera, .. } in cameras {
        let along = axis(camera, DVec3::Z);
        let across = DMat3::IDENTITY - DMat3::from_cols(along * along.x, along * along.y, along * along.z);
        matrix += across;
        moment += across * camera.pose.center();
    }
    let spread =
        cameras.iter().map(|camera| camera.camera.pose.center().distance(position)).fold(0.0, f64::max);
    let count = cameras.len() as f64;
    // The determinant of the mean falls to zero as the axes become parallel.
    let well_posed = (matrix * (1.0 / count)).determinant() > 1e-4;
    let meeting = well_posed.then(|| matrix.inverse() * moment).filter(|point| point.is_finite());
    let distance = meeting.map(|point| (point - position).dot(ahead));
    let distance = distance.filter(|distance| *distance > 1e-3 * spread && *distance > 0.0);
    position + ahead * distance.unwrap_or(if spread > 0.0 { spread } else { 1.0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Intrinsics, Pose, Split};

    fn camera(position: DVec3, target: DVec3, split: Split) -> NamedCamera {
        let intrinsics = Intrinsics { fx: 50.0, fy: 50.0, cx: 50.0, cy: 25.0, width: 100, height: 50 };
        let pose = Pose::look_at(position, target, DVec3::Z).expect("a view");
        NamedCamera { name: String::new(), split, camera: Camera { intrinsics, pose } }
    }

    #[test]
    fn the_viewer_turns_about_what_the_cameras_look_at() {
        let target = DVec3::new(1.0, 2.0, 0.5);
        let around = |angle: f64| target + DVec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 1.0);
        let mut cameras: Vec<_> =
            (0..8).map(|i| camera(around(f64::from(i)), target, Split::Train)).collect();
        cameras[3].split = Split::Test;
        let orbit = Orbit::of(&cameras).expect("cameras");
        assert!(orbit.center.distance(target) < 1e-9, "{orbit:?}");
        assert!(orbit.position.distance(around(3.0)) < 1e-9);
        assert!(orbit.up.dot(DVec3::Z) > 0.9);
        assert!((orbit.fov - 90.0).abs() < 1e-9 && (orbit.aspect - 2.0).abs() < 1e-9);
    }

    #[test]
    fn cameras_that_look_the_same_way_still_have_a_center_ahead() {
        let ahead = DVec3::X;
        let row = |y: f64| camera(DVec3::new(0.0, y, 0.0), DVec3::new(1.0, y, 0.0), Split::Train);
        for cameras in [vec![row(0.0)], vec![row(0.0), row(3.0)]] {
            let orbit = Orbit::of(&cameras).expect("cameras");
            assert!((orbit.center - orbit.position).dot(ahead) > 0.5, "{orbit:?}");
        }
        // Axes that meet only a hundred times as far away as the cameras stand apart are as good as parallel.
        let nearly = |y: f64| camera(DVec3::new(0.0, y, 0.0), DVec3::new(100.0, 0.5, 0.0), Split::Train);
        let orbit = Orbit::of(&[nearly(0.0), nearly(1.0)]).expect("cameras");
        assert!((orbit.center.distance(orbit.position) - 1.0).abs() < 0.1, "{orbit:?}");
        assert_eq!(Orbit::of(&[]), None);
    }
}
