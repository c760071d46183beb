//! Where the photographs are taken from: two rings around the scene, looking slightly down. A video walks from the lower to the upper.

use glam::DVec3;
use libm::{cos, sin};

use super::Settings;
use crate::domain::{Camera, Intrinsics, Pose};

/// The lower and the upper ring.
const RINGS: [Ring; 2] =
    [Ring { views: 28, elevation: 0.27, distance: 3.7 }, Ring { views: 20, elevation: 0.75, distance: 3.9 }];

/// Every how many views one is held out.
const HOLD_OUT_EVERY: usize = 6;

/// Focal length as a multiple of the image's shorter side (about 49 degrees of view).
const FOCAL: f64 = 1.1;

/// Turns of a walk around the scene.
const WALK_TURNS: f64 = 2.0;

struct Ring {
    /// Views of 48.
    views: usize,
    /// Radians above the ground.
    elevation: f64,
    distance: f64,
}

/// The cameras, ring by ring.
pub(super) fn cameras(settings: &Settings) -> Vec<Camera> {
    let [lower, upper] = &RINGS;
    let low_views = settings.views * lower.views / (lower.views + upper.views);
    let low = (0..low_views).map(|index| (lower, index, low_views));
    let high_views = settings.views - low_views;
    let high = (0..high_views).map(|index| (upper, index, high_views));
    low.chain(high)
        .map(|(ring, index, views)| {
            let turn = std::f64::consts::TAU * index as f64 / views as f64;
            camera(settings, turn, ring.elevation, ring.distance)
        })
        .collect()
}

/// The cameras of a walk from the lower ring up to the upper one, in order.
pub(super) fn walk(settings: &Settings) -> Vec<Camera> {
    let [lower, upper] = &RINGS;
    let between = |from: f64, to: f64, share: f64| from + (to - from) * share;
    (0..settings.views)
        .map(|index| {
            let share = index as f64 / settings.views as f64;
            let elevation = between(lower.elevation, upper.elevation, share);
            let distance = between(lower.distance, upper.distance, share);
            camera(settings, WALK_TURNS * std::f64::consts::TAU * share, elevation, distance)
        })
        .collect()
}

/// The camera after `turn` radians around the scene.
fn camera(settings: &Settings, turn: f64, elevation: f64, distance: f64) -> Camera {
    let target = DVec3::new(0.12, 0.1, 0.32);
    let Settings { width, height, .. } = *settings;
    let focal = FOCAL * f64::from(width.min(height));
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx, cy, width, height };
    // A small rise and fall keeps the centers off one plane, as a hand-held walk would.
    let elevation = elevation + 0.06 * sin(3.0 * turn);
    let flat = DVec3::new(cos(turn), sin(turn), 0.0) * cos(elevation);
    let position = target + (flat + DVec3::Z * sin(elevation)) * distance;
    let pose = Pose::look_at(position, target, DVec3::Z).expect("the rings look at the scene");
    Camera::new(intrinsics, pose).expect("the caller checked the size")
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
        let cameras = cameras(&Settings::square(200));
        assert_eq!(cameras.len(), 48);
        assert_eq!((0..cameras.len()).filter(|index| is_held_out(*index)).count(), 8);
        for camera in &cameras {
            assert!(camera.pose.center().z > 0.5, "above the ground");
            let (at, _) = camera.project(DVec3::new(0.0, 0.0, 0.4)).expect("the scene is in front");
            assert!((60.0..140.0).contains(&at.x) && (60.0..140.0).contains(&at.y), "{at}");
        }
    }
    #[test]
    fn a_walk_has_no_jump() {
        let settings = Settings { width: 64, height: 36, views: 100, ..Settings::default() };
        let cameras = walk(&settings);
        assert_eq!(cameras.len(), 100);
        for pair in cameras.windows(2) {
            assert!(pair[0].pose.center().distance(pair[1].pose.center()) < 0.6);
        }
        let (at, _) = cameras[50].project(DVec3::new(0.0, 0.0, 0.4)).expect("the scene is in front");
        assert!((20.0..44.0).contains(&at.x) && (6.0..30.0).contains(&at.y), "{at}");
    }
}
