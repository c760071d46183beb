//! The frame of a scene: where its coordinates are in the world of its cameras.
//!
//! A scene is trained, stored and rendered in coordinates of its own: around its own center, and in a unit that makes the distance
//! of cameras from what they show about [`TYPICAL_DISTANCE`]. So neither the unit nor the place of a dataset changes a scene, and single
//! precision has the same accuracy everywhere. Cameras have world coordinates everywhere outside of training, and are converted in
//! double precision before a scene is rendered.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{Camera, Pose};

/// Distance of the cameras of a trained scene from its points in the scene's frame. Constants of training are lengths in this unit: the
/// weight of volumes, rates of offsets, the distance that networks see. They were found on sets whose cameras are 4 to 9 world units
/// away (docs/ANALYSIS.md, "The unit of a scene's frame").
pub const TYPICAL_DISTANCE: f64 = 5.0;

/// Distance of a scene from the world's origin, in typical distances, beyond which single precision in world coordinates would move
/// Gaussians by a visible part of a pixel: it rounds there by up to a 30 000th of a typical distance.
const FAR: f64 = 512.0;

/// `world = offset + scale * scene`, per axis. The offset is finite; the scale is positive and normal, and so is one over it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "StoredFrame", into = "StoredFrame")]
pub struct SceneFrame {
    offset: DVec3,
    scale: f64,
}

impl SceneFrame {
    /// The world's own: that of scenes that state none.
    pub const WORLD: Self = Self { offset: DVec3::ZERO, scale: 1.0 };

    /// A frame with its origin at `offset` whose unit is `scale` world units long; none if one of the numbers is not allowed.
    #[must_use]
    pub fn new(offset: DVec3, scale: f64) -> Option<Self> {
        let allowed = scale > 0.0 && scale.is_normal() && scale.recip().is_normal() && offset.is_finite();
        allowed.then_some(Self { offset, scale })
    }

    /// The frame of a scene around `center` whose cameras are typically `distance` world units from its points.
    #[must_use]
    pub fn around(center: DVec3, distance: f64) -> Option<Self> {
        Self::new(center, distance / TYPICAL_DISTANCE)
    }

    /// World coordinates of the frame's origin.
    #[must_use]
    pub fn offset(&self) -> DVec3 {
        self.offset
    }

    /// World units to a unit of the frame.
    #[must_use]
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// Whether its coordinates are those of the world.
    #[must_use]
    pub fn is_world(&self) -> bool {
        *self == Self::WORLD
    }

    /// Whether single precision in world coordinates would lose detail that is visible.
    #[must_use]
    pub fn is_far_out(&self) -> bool {
        self.offset.abs().max_element() > FAR * TYPICAL_DISTANCE * self.scale
    }

    /// Coordinates in the frame of a point of the world.
    #[must_use]
    pub fn from_world(&self, point: DVec3) -> DVec3 {
        (point - self.offset) / self.scale
    }

    /// World coordinates of a point of the frame.
    #[must_use]
    pub fn to_world(&self, point: DVec3) -> DVec3 {
        self.offset + self.scale * point
    }

    /// The same camera in the frame.
    #[must_use]
    pub fn camera_from_world(&self, camera: &Camera) -> Camera {
        let rotation = camera.pose.rotation();
        let translation = (rotation * self.offset + camera.pose.translation()) / self.scale;
        Camera { pose: Pose::of_rigid(rotation, translation), ..*camera }
    }

    /// The camera in the world of one in the frame.
    #[must_use]
    pub fn camera_to_world(&self, camera: &Camera) -> Camera {
        let rotation = camera.pose.rotation();
        let translation = self.scale * camera.pose.translation() - rotation * self.offset;
        Camera { pose: Pose::of_rigid(rotation, translation), ..*camera }
    }
}

impl Default for SceneFrame {
    fn default() -> Self {
        Self::WORLD
    }
}

/// The numbers of a frame, as text has them.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct StoredFrame {
    offset: [f64; 3],
    scale: f64,
}

impl From<SceneFrame> for StoredFrame {
    fn from(frame: SceneFrame) -> Self {
        Self { offset: frame.offset.to_array(), scale: frame.scale }
    }
}

impl TryFrom<StoredFrame> for SceneFrame {
    type Error = String;

    fn try_from(stored: StoredFrame) -> Result<Self, String> {
        let StoredFrame { offset, scale } = stored;
        Self::new(offset.into(), scale)
            .ok_or_else(|| format!("offset {offset:?} and scale {scale} are not those of a scene's frame"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Intrinsics;

    fn camera() -> Camera {
        let intrinsics = Intrinsics { fx: 500.0, fy: 510.0, cx: 320.0, cy: 240.0, width: 640, height: 480 };
        let pose =
            Pose::look_at(DVec3::new(500_003.0, 4_000_001.0, 12.0), DVec3::new(5e5, 4e6, 10.0), DVec3::Z);
        Camera::new(intrinsics, pose.expect("a view")).expect("a camera")
    }

    #[test]
    fn a_camera_sees_the_same_in_the_frame_and_comes_back_from_it() {
        let frame = SceneFrame::around(DVec3::new(5e5, 4e6, 10.0), 3.0).expect("a frame");
        let inside = frame.camera_from_world(&camera());
        for point in [DVec3::ZERO, DVec3::new(0.1, -0.2, 0.3)] {
            let (there, depth) = inside.project(point).expect("in front");
            let (world, far) = camera().project(frame.to_world(point)).expect("in front");
            assert!((there - world).length() < 1e-5, "{there} {world}");
            assert!((depth * frame.scale() / far - 1.0).abs() < 1e-9);
            assert!((frame.from_world(frame.to_world(point)) - point).length() < 1e-8);
        }
        let back = frame.camera_to_world(&inside);
        assert!((back.pose.center() - camera().pose.center()).length() < 1e-8);
        assert_eq!(back.pose.rotation(), camera().pose.rotation());
    }

    #[test]
    fn lengths_times_a_power_of_two_change_no_bit_of_a_camera_in_its_frame() {
        let world = camera();
        let frame = SceneFrame::around(DVec3::new(499_999.0, 4e6, 11.0), 3.7).expect("a frame");
        for factor in [0.125, 2.0, 1024.0] {
            let pose = Pose::of_rigid(world.pose.rotation(), factor * world.pose.translation());
            let scaled = SceneFrame::around(factor * frame.offset(), factor * 3.7).expect("a frame");
            let inside = scaled.camera_from_world(&Camera { pose, ..world });
            assert_eq!(inside, frame.camera_from_world(&world), "{factor}");
        }
    }

    #[test]
    fn it_is_far_out_where_single_precision_is_too_coarse() {
        let frame =
            |offset: f64, distance: f64| SceneFrame::around(DVec3::Y * offset, distance).expect("a frame");
        assert!(!frame(0.0, 1.0).is_far_out() && !frame(100.0, 4.0).is_far_out());
        assert!(frame(5e5, 6.0).is_far_out() && frame(-4e6, 100.0).is_far_out());
        assert!(!SceneFrame::WORLD.is_far_out());
    }

    #[test]
    fn text_keeps_every_bit_and_no_other_numbers_are_taken() {
        // A parser that rounds some digits away finds other bits of some of these.
        for step in 1..1000 {
            let scale = f64::from(step).sqrt() / 5.0;
            let frame = SceneFrame::new(DVec3::new(0.1 + scale, -1e9, 3.0), scale).expect("a frame");
            let text = serde_json::to_string(&frame).expect("text");
            assert_eq!(serde_json::from_str::<SceneFrame>(&text).expect("a frame"), frame);
        }
        for (offset, scale) in [("0", "0"), ("0", "-1"), ("0", "1e-310"), ("0", "1e309"), ("1e400", "1")] {
            let text = format!("{{\"offset\":[{offset},0,0],\"scale\":{scale}}}");
            assert!(serde_json::from_str::<SceneFrame>(&text).is_err(), "{text}");
        }
    }
}
