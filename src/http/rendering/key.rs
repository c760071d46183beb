//! The identity of a picture: cache key and entity tag.

use std::{
    fmt::{self, Write as _},
    sync::Arc,
};

use sha2::{Digest as _, Sha256};

use super::picture::PictureKind;
use crate::{
    domain::{Camera, Digest},
    render::RenderViews,
};

/// Relative to the largest number beside it, a smaller number counts as zero with a rounding error.
const ZERO: f64 = 1e-12;

/// One picture of one file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FrameSpec {
    pub(crate) artifact: Digest,
    pub(crate) camera: Camera,
    pub(crate) kind: PictureKind,
}

/// A picture and what renders it.
#[derive(Clone)]
pub(crate) struct RenderFrame {
    pub(crate) spec: FrameSpec,
    pub(crate) renderer: Arc<dyn RenderViews>,
}

impl fmt::Debug for RenderFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Frame").field("spec", &self.spec).finish_non_exhaustive()
    }
}

impl RenderFrame {
    pub(crate) fn key(&self) -> ViewKey {
        ViewKey::new(&self.renderer.identity(), &self.spec)
    }
}

/// The SHA-256 of everything that determines a picture's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct ViewKey(Digest);

impl ViewKey {
    /// The key of a frame rendered by `identity`. The camera is rounded to f32, as on the device, so one pose has one key however it
    /// was written.
    pub(crate) fn new(identity: &str, frame: &FrameSpec) -> Self {
        Self::encoded_by(frame.kind.encoder(), identity, frame)
    }

    /// The key of a frame that is encoded by another encoder or with other settings of it.
    fn encoded_by(encoder: &str, identity: &str, frame: &FrameSpec) -> Self {
        let FrameSpec { artifact, camera: Camera { intrinsics: k, pose }, kind } = frame;
        let mut text = format!(
            "tcgs {} view by {identity} of {artifact} as {kind:?} by {encoder} {}x{}",
            env!("CARGO_PKG_VERSION"),
            k.width,
            k.height
        );
        let parts = [
            pose.rotation().to_cols_array().as_slice(),
            &pose.translation().to_array(),
            &pose.center().to_array(),
            &[k.fx, k.fy, k.cx, k.cy],
        ]
        .map(rounded);
        for number in parts.iter().flatten() {
            // Writing to a string cannot fail.
            let _ = write!(text, " {number:e}");
        }
        Self(Digest::of(text.as_bytes()))
    }

    /// The key of a sequence of pictures in a format.
    pub(crate) fn of_many(keys: impl Iterator<Item = Self>, how: &str) -> Self {
        let mut hash = Sha256::new();
        keys.for_each(|key| hash.update(key.0.as_bytes()));
        hash.update(how.as_bytes());
        Self(Digest::of(&hash.finalize()))
    }
}

/// Hexadecimal digits: an entity tag, or a multipart boundary that occurs in no file by accident.
impl fmt::Display for ViewKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

fn rounded(numbers: &[f64]) -> Vec<f32> {
    let largest = numbers.iter().fold(0.0_f64, |largest, number| largest.max(number.abs()));
    numbers.iter().map(|number| if number.abs() <= ZERO * largest { 0.0 } else { *number as f32 }).collect()
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::{
        domain::{Convention, Intrinsics, Pose},
        http::rendering::{Format, Output},
    };

    fn frame() -> FrameSpec {
        let intrinsics = Intrinsics { fx: 50.0, fy: 55.0, cx: 21.0, cy: 15.5, width: 40, height: 32 };
        let pose = Pose::look_at(DVec3::new(4.0, 0.0, 0.0), DVec3::ZERO, DVec3::Z).expect("a view");
        let kind = PictureKind::new(None, None, None, Format::Png).expect("a kind");
        FrameSpec { artifact: Digest::of(b"a"), camera: Camera { intrinsics, pose }, kind }
    }

    #[test]
    fn one_view_has_one_key_however_it_is_written() {
        let frame = frame();
        let key = ViewKey::new("renderer", &frame);
        for convention in [Convention::Opencv, Convention::Opengl] {
            let matrix = frame.camera.pose.camera_to_world(convention);
            let pose = Pose::from_camera_to_world(matrix, convention).expect("a pose");
            let same = FrameSpec { camera: Camera { pose, ..frame.camera }, ..frame };
            assert_eq!(ViewKey::new("renderer", &same), key, "{convention:?}");
        }
        let nudged = Pose::look_at(DVec3::new(4.0, 1e-15, 0.0), DVec3::ZERO, DVec3::Z).expect("a view");
        let same = FrameSpec { camera: Camera { pose: nudged, ..frame.camera }, ..frame };
        assert_eq!(ViewKey::new("renderer", &same), key);
        // Of large numbers, rounding errors are larger too.
        let far = |y: f64| {
            let pose = Pose::look_at(DVec3::new(4e6, y, 0.0), DVec3::ZERO, DVec3::Z).expect("a view");
            ViewKey::new("renderer", &FrameSpec { camera: Camera { pose, ..frame.camera }, ..frame })
        };
        assert_eq!(far(0.0), far(1e-9));
    }

    #[test]
    fn whatever_changes_the_picture_changes_the_key() {
        let frame = frame();
        let moved = Pose::look_at(DVec3::new(4.0, 1e-5, 0.0), DVec3::ZERO, DVec3::Z).expect("a view");
        let with = |change: &dyn Fn(&mut FrameSpec)| {
            let mut other = frame;
            change(&mut other);
            ViewKey::new("renderer", &other)
        };
        let keys = [
            ViewKey::new("renderer", &frame),
            ViewKey::new("another renderer", &frame),
            with(&|frame| frame.artifact = Digest::of(b"b")),
            with(&|frame| frame.camera.pose = moved),
            with(&|frame| frame.camera.intrinsics.fx += 0.1),
            with(&|frame| frame.camera.intrinsics.cy += 0.1),
            with(&|frame| frame.camera.intrinsics.width += 1),
            with(&|frame| frame.kind.output = Output::Depth),
            with(&|frame| frame.kind.format = Format::Webp),
            with(&|frame| frame.kind.quality = 1),
            ViewKey::encoded_by("another encoder", "renderer", &frame),
            ViewKey::encoded_by("another encoder 2.0", "renderer", &frame),
        ];
        for (index, key) in keys.iter().enumerate() {
            assert!(!keys[..index].contains(key), "{index}");
        }
        assert_eq!(ViewKey::encoded_by(frame.kind.encoder(), "renderer", &frame), keys[0]);
        let many = |how| ViewKey::of_many(keys.into_iter(), how);
        assert_ne!(many("slowly"), many("fast"));
        assert_eq!(many("fast"), many("fast"));
    }
}
