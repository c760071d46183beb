//! Where the photographs are taken from: two rings around the scene, looking slightly down.

use glam::DVec3;
use libm::{cos, sin};

use crate::domain::{Camera, Intrinsics, Pose};

/// Views on the lower and on the upper ring.
const RINGS: [Ring; 2] =
    [Ring { views: 28, elevation: 0.27, distance: 3.7 }, Ring { views: 20, elevation: 0.75, distance: 3.9 }];

/// Every how many views one is held out.
const HOLD_OUT_EVERY: usize = 6;

/// Focal length as a multiple of the image's side (about 49 degrees of view).
const FOCAL: f64 = 1.1;

struct Ring {
    views: usize,
    /// Radians above the ground.
    elevation: f64,
    distance: f64,
}

/// The cameras, ring by ring, for square images of `side` pixels.
pub(super) fn cameras(side: u32) -> Vec<Camera> {
    let target = DVec3::new(0.12, 0.1, 0.32);
    let middle = f64::from(side) / 2.0;
    let focal = FOCAL * f64::from(side);
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: middle, cy: middle, width: side, height: side };
    RINGS
        .iter()
        .flat_map(|ring| (0..ring.views).map(move |index| (ring, index)))
        .map(|(ring, index)| {
            let turn = std::f64::consts::TAU * index as f64 / ring.views as f64;
            // A small rise and fall keeps the centers off one plane, as a hand-held walk would.
            let elevation = ring.elevation + 0.06 * sin(3.0 * turn);
            let flat = DVec3::new(cos(turn), sin(turn), 0.0) * cos(elevation);
            let position = target + (flat + DVec3::Z * sin(elevation)) * ring.distance;
            let pose = Pose::look_at(position, target, DVec3::Z).expect("the rings look at the scene");
            Camera::new(intrinsics, pose).expect("the caller checked the side")
        })
        .collect()
}

/// Whether the view of this index is held out.
pub(super) fn is_held_out(index: usize) -> bool {
    index.is_multiple_of(HOLD_OUT_EVERY)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forty_eight_views_surround_the_scene_and_eight_are_held_out() {
        let cameras = cameras(200);
        assert_eq!(cameras.len(), 48);
        assert_eq!((0..cameras.len()).filter(|index| is_held_out(*index)).count(), 8);
        for camera in &cameras {
            assert!(camera.pose.center().z > 0.5, "above the ground");
            let (at, _) = camera.project(DVec3::new(0.0, 0.0, 0.4)).expect("the scene is in front");
            assert!((60.0..140.0).contains(&at.x) && (60.0..140.0).contains(&at.y), "{at}");
        }
    }
}
