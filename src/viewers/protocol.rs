//! Messages between a replica and a viewer: a head in postcard's format, which keeps every bit of a number, then raw bytes.
//!
//! Both sides are of one version (a replica asks no viewer of another), so messages have no version of their own.

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use thiserror::Error;

use crate::{
    domain::{Camera, CameraError, Digest, ExportFidelity, NamedCamera, Pose, SceneFormat},
    render::views::ScalarKind,
};

/// Path of [`RenderRequest`]s.
pub const RENDER: &str = "/render";

/// Path of [`ExportRequest`]s.
pub const EXPORT: &str = "/export";

/// Longest request for a picture.
pub const MAX_RENDER_REQUEST: usize = 64 << 10;

/// Longest request for an export: 100 000 cameras with names of 500 bytes.
pub const MAX_EXPORT_REQUEST: usize = 64 << 20;

/// Bytes of a head's length.
const LENGTH: usize = 4;

/// Why a message is refused.
#[derive(Debug, Error)]
pub enum MessageError {
    /// It is shorter than it states.
    #[error("the message is cut short")]
    Truncated,
    /// Its head is not of the kind that is expected.
    #[error("the message's head cannot be read: {0}")]
    Head(#[from] postcard::Error),
    /// It asks for a view that no camera has.
    #[error("impossible camera: {0}")]
    Camera(#[from] CameraError),
}

/// What a picture shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Channels {
    /// Colors: bytes, 3 or 4 a pixel.
    Color,
    /// Numbers: f32, little-endian, one a pixel.
    Scalars(ScalarKind),
}

/// Asks for a picture of a finished scene.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RenderRequest {
    /// The scene's file.
    pub artifact: Digest,
    /// From where.
    pub camera: Camera,
    /// What it shows.
    pub channels: Channels,
}

/// The head of a picture; its samples follow, row by row from the top.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct PictureHead {
    /// Channels of a pixel: 3 or 4 of colors, 1 of numbers.
    pub channels: u8,
}

/// Asks for a finished scene in another format.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExportRequest {
    /// The scene's file.
    pub artifact: Digest,
    /// The name of the format.
    pub format: SceneFormat,
    /// The dataset's cameras.
    pub cameras: Vec<NamedCamera>,
}

/// The head of an export; its bytes follow.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ExportHead {
    /// How many Gaussians it has.
    pub gaussians: u64,
    /// Highest degree of its spherical harmonics.
    pub sh_degree: u8,
    /// Its fidelity to the scene, if it could be measured.
    pub fidelity: Option<ExportFidelity>,
}

/// A message with this head and these bytes.
///
/// # Errors
/// [`MessageError::Head`] for a head beyond 4 GiB.
pub fn write(head: &impl Serialize, bytes: &[u8]) -> Result<Vec<u8>, MessageError> {
    let head = postcard::to_allocvec(head)?;
    let length = u32::try_from(head.len()).map_err(|_| postcard::Error::SerializeBufferFull)?;
    Ok([&length.to_le_bytes(), &*head, bytes].concat())
}

/// The head of a message, and the bytes after it.
///
/// # Errors
/// [`MessageError::Truncated`], [`MessageError::Head`].
pub fn read<T: DeserializeOwned>(message: &[u8]) -> Result<(T, &[u8]), MessageError> {
    let (length, rest) = message.split_first_chunk::<LENGTH>().ok_or(MessageError::Truncated)?;
    let length = u32::from_le_bytes(*length) as usize;
    let (head, bytes) = rest.split_at_checked(length).ok_or(MessageError::Truncated)?;
    Ok((postcard::from_bytes(head)?, bytes))
}

/// Checks a camera that a message has, which was read without its constructors.
///
/// # Errors
/// [`MessageError::Camera`].
pub fn check(camera: &Camera) -> Result<(), MessageError> {
    camera.intrinsics.validated()?;
    Pose::from_world_to_camera(camera.pose.rotation(), camera.pose.translation())?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::domain::Intrinsics;

    fn request() -> RenderRequest {
        let intrinsics =
            Intrinsics { fx: 50.1, fy: 1.0 / 3.0, cx: 21.0, cy: 0.1 + 0.2, width: 40, height: 32 };
        let pose = Pose::look_at(DVec3::new(0.7, 1.3, 2.9), DVec3::ZERO, DVec3::Z).expect("a view");
        let channels = Channels::Scalars(ScalarKind::Depth);
        RenderRequest { artifact: Digest::of(b"a"), camera: Camera { intrinsics, pose }, channels }
    }

    #[test]
    fn a_message_keeps_every_bit_and_is_refused_at_any_shorter_length() {
        let message = write(&request(), b"samples").expect("it fits");
        let (back, bytes) = read::<RenderRequest>(&message).expect("a message");
        assert_eq!((back, bytes), (request(), &b"samples"[..]));
        for length in 0..message.len() - b"samples".len() {
            assert!(read::<RenderRequest>(&message[..length]).is_err(), "{length}");
        }
        assert!(read::<ExportRequest>(&message).is_err() || read::<PictureHead>(&[255; 4]).is_err());
    }

    #[test]
    fn a_camera_that_no_constructor_would_make_is_refused() {
        assert!(check(&request().camera).is_ok());
        let mut wide = request().camera;
        wide.intrinsics.width = 0;
        assert!(matches!(check(&wide), Err(MessageError::Camera(_))));
        let mut blind = request().camera;
        blind.intrinsics.fx = f64::NAN;
        assert!(check(&blind).is_err());
    }
}
