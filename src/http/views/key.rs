//! What makes one picture the same as another.

use std::fmt::Write as _;

use sha2::{Digest as _, Sha256};

use crate::{
    domain::{Camera, Digest},
    http::{etag::Etag, picture::PictureKind},
};

/// Below this part of the largest number beside it, a number is what rounding left of zero.
const ZERO: f64 = 1e-12;

/// One picture of one file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shot {
    pub(super) artifact: Digest,
    pub(super) camera: Camera,
    pub(super) kind: PictureKind,
}

/// The SHA-256 of everything that decides on a picture's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Key(Digest);

impl Key {
    /// The key of a shot by a renderer of that identity. The camera counts as the device sees it, in f32, so one pose is
    /// one key however it was written.
    pub(super) fn new(identity: &str, shot: &Shot) -> Self {
        let Shot { artifact, camera: Camera { intrinsics: k, pose }, kind } = shot;
        let mut text = format!(
            "tcgs {} view by {identity} of {artifact} as {kind:?} {}x{}",
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

    /// The key of many pictures in a row, shown as `how` says.
    pub(super) fn of_many(keys: impl Iterator<Item = Self>, how: &str) -> Self {
        let mut hash = Sha256::new();
        keys.for_each(|key| hash.update(key.0.as_bytes()));
        hash.update(how.as_bytes());
        Self(Digest::of(&hash.finalize()))
    }

    pub(super) fn etag(self) -> Etag {
        Etag::new(self.0)
    }

    /// Text that is in no file by accident, to tell its parts apart.
    pub(super) fn boundary(self) -> String {
        self.0.to_string()
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
        http::picture::{Format, Output},
    };

    fn shot() -> Shot {
        let intrinsics = Intrinsics { fx: 50.0, fy: 55.0, cx: 21.0, cy: 15.5, width: 40, height: 32 };
        let pose = Pose::look_at(DVec3::new(4.0, 0.0, 0.0), DVec3::ZERO, DVec3::Z).expect("a view");
        let kind = PictureKind::new(None, None, None, Format::Png).expect("a kind");
        Shot { artifact: Digest::of(b"a"), camera: Camera { intrinsics, pose }, kind }
    }

    #[test]
    fn one_view_has_one_key_however_it_is_written() {
        let shot = shot();
        let key = Key::new("renderer", &shot);
        for convention in [Convention::Opencv, Convention::Opengl] {
            let matrix = shot.camera.pose.camera_to_world(convention);
            let pose = Pose::from_camera_to_world(matrix, convention).expect("a pose");
            let same = Shot { camera: Camera { pose, ..shot.camera }, ..shot };
            assert_eq!(Key::new("renderer", &same), key, "{convention:?}");
        }
        let nudged = Pose::look_at(DVec3::new(4.0, 1e-15, 0.0), DVec3::ZERO, DVec3::Z).expect("a view");
        let same = Shot { camera: Camera { pose: nudged, ..shot.camera }, ..shot };
        assert_eq!(Key::new("renderer", &same), key);
    }

    #[test]
    fn whatever_changes_the_picture_changes_the_key() {
        let shot = shot();
        let moved = Pose::look_at(DVec3::new(4.0, 1e-5, 0.0), DVec3::ZERO, DVec3::Z).expect("a view");
        let with = |change: &dyn Fn(&mut Shot)| {
            let mut other = shot;
            change(&mut other);
            Key::new("renderer", &other)
        };
        let keys = [
            Key::new("renderer", &shot),
            Key::new("another renderer", &shot),
            with(&|shot| shot.artifact = Digest::of(b"b")),
            with(&|shot| shot.camera.pose = moved),
            with(&|shot| shot.camera.intrinsics.fx += 0.1),
            with(&|shot| shot.camera.intrinsics.cy += 0.1),
            with(&|shot| shot.camera.intrinsics.width += 1),
            with(&|shot| shot.kind.output = Output::Depth),
            with(&|shot| shot.kind.format = Format::Webp),
            with(&|shot| shot.kind.quality = 1),
        ];
        for (index, key) in keys.iter().enumerate() {
            assert!(!keys[..index].contains(key), "{index}");
        }
        let many = |how| Key::of_many(keys.into_iter(), how);
        assert_ne!(many("slowly"), many("fast"));
        assert_eq!(many("fast"), many("fast"));
    }
}
