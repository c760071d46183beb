//! Interpolation of cameras.

use glam::DQuat;

use super::{Camera, CameraError, Intrinsics, Pose};

/// The camera a fraction `t` of the way from one to another of the same image size: rotations along the shortest arc,
/// everything else along a line.
///
/// # Errors
/// [`CameraError`], which interpolation between two valid cameras does not give.
pub fn between(from: &Camera, to: &Camera, t: f64) -> Result<Camera, CameraError> {
    if t == 0.0 {
        return Ok(*from);
    }
    let mix = |a: f64, b: f64| a + t * (b - a);
    let turn = |camera: &Camera| DQuat::from_mat3(&camera.pose.rotation());
    let rotation = glam::DMat3::from_quat(turn(from).slerp(turn(to), t).normalize());
    let center = from.pose.center().lerp(to.pose.center(), t);
    let pose = Pose::from_world_to_camera(rotation, -(rotation * center))?;
    let (a, b) = (&from.intrinsics, &to.intrinsics);
    let intrinsics = Intrinsics {
        fx: mix(a.fx, b.fx),
        fy: mix(a.fy, b.fy),
        cx: mix(a.cx, b.cx),
        cy: mix(a.cy, b.cy),
        width: a.width,
        height: a.height,
    };
    Camera::new(intrinsics, pose)
}

/// `frames` cameras along `keys`, the same number between each two neighbors: from the first to the last, or, if `closed`, on
/// to just before the first again.
///
/// # Errors
/// As [`between`].
pub fn along(keys: &[Camera], frames: usize, closed: bool) -> Result<Vec<Camera>, CameraError> {
    let (Some(first), Some(last)) = (keys.first(), keys.last()) else { return Ok(Vec::new()) };
    let legs = if closed { keys.len() } else { keys.len() - 1 };
    let steps = if closed { frames } else { frames.saturating_sub(1) }.max(1);
    let at = |index: usize| {
        let way = index * legs;
        let (leg, t) = (way / steps, (way % steps) as f64 / steps as f64);
        between(keys.get(leg).unwrap_or(last), keys.get(leg + 1).unwrap_or(first), t)
    };
    (0..frames).map(at).collect()
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn camera(position: DVec3, target: DVec3, f: f64) -> Camera {
        let intrinsics = Intrinsics { fx: f, fy: f, cx: 20.0, cy: 15.0, width: 40, height: 30 };
        Camera::new(intrinsics, Pose::look_at(position, target, DVec3::Z).expect("a view")).expect("a camera")
    }

    #[test]
    fn a_path_passes_its_keys_and_turns_evenly_between_them() {
        let east = camera(DVec3::ZERO, DVec3::X, 50.0);
        let north = camera(DVec3::new(0.0, 0.0, 2.0), DVec3::new(0.0, 1.0, 2.0), 70.0);
        let west = camera(DVec3::ZERO, DVec3::NEG_X, 50.0);
        let path = along(&[east, north, west], 9, false).expect("a path");
        assert_eq!((path[0], path[4], path[8]), (east, north, west));
        let ahead = path[2].pose.rotation().row(2);
        let half = DVec3::new(1.0, 1.0, 0.0).normalize();
        assert!(ahead.distance(half) < 1e-12, "{ahead}");
        assert!(path[2].pose.center().distance(DVec3::new(0.0, 0.0, 1.0)) < 1e-12);
        assert!((path[2].intrinsics.fx - 60.0).abs() < 1e-12);
        let round = along(&[east, north, west], 6, true).expect("a path");
        assert_eq!((round[0], round[2], round[4]), (east, north, west));
        assert_ne!(round[5], east, "the next round begins there");
    }

    #[test]
    fn short_paths_are_paths() {
        let only = camera(DVec3::ZERO, DVec3::X, 50.0);
        assert_eq!(along(&[only], 3, false).expect("a path"), vec![only; 3]);
        assert_eq!(along(&[only], 2, true).expect("a path").len(), 2);
        assert_eq!(along(&[only, only], 1, false).expect("a path"), vec![only]);
        assert_eq!(along(&[], 5, false).expect("a path"), vec![]);
    }
}
