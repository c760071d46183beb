//! Reads cameras from requests: a dataset frame by name, a look-at view, or a pose matrix.

use std::num::NonZeroU32;

use glam::{DMat3, DVec3};

use crate::{
    domain::{
        Camera, CameraError, Intrinsics, NamedCamera, Pose, ProblemType, View, ViewError, ViewRequest,
        dataset::find_name,
    },
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        request::Parameters,
    },
};

const DEFAULT_FOV_DEGREES: f64 = 60.0;
const DEFAULT_WIDTH: u32 = 640;
const DEFAULT_HEIGHT: u32 = 480;
/// Frame names in the problem of an unknown one.
const NAMES_SHOWN: usize = 3;

/// A requested camera, before the dataset's cameras are read.
#[derive(Debug)]
pub(crate) struct CameraSpec(View);

impl CameraSpec {
    /// Reads `frame`, or `position` with either `look_at` and `up` or `quat`, and `fov`, and `width`, `height`.
    pub(crate) fn from_query(parameters: &mut Parameters) -> ApiResult<Self> {
        let width = side(parameters, "width")?;
        let height = side(parameters, "height")?;
        let position = parameters.take_vector("position")?;
        let look_at = parameters.take_vector("look_at")?;
        let up = parameters.take_vector("up")?;
        let quat = parameters.take_quaternion("quat")?;
        let fov: Option<f64> = parameters.take_as("fov", "a number of degrees")?;
        if let Some(name) = parameters.take("frame") {
            let given = [
                ("position", position.is_some()),
                ("look_at", look_at.is_some()),
                ("up", up.is_some()),
                ("quat", quat.is_some()),
                ("fov", fov.is_some()),
            ];
            if let Some((other, _)) = given.iter().find(|(_, is_given)| *is_given) {
                return Err(ProblemResponse::parameter(
                    other,
                    "cannot be combined with frame, which has its own camera",
                ));
            }
            return Ok(Self(View::Frame { name, width, height }));
        }
        let needed = |name, value: Option<DVec3>| {
            value.ok_or_else(|| {
                ProblemResponse::parameter(name, "is needed, unless frame names a dataset camera")
            })
        };
        let position = needed("position", position)?;
        let pose = match quat {
            Some(quat) => {
                let given = [("look_at", look_at), ("up", up)];
                if let Some((other, _)) = given.iter().find(|(_, value)| value.is_some()) {
                    return Err(ProblemResponse::parameter(
                        other,
                        "cannot be combined with quat, which turns the camera",
                    ));
                }
                let rotation = DMat3::from_quat(quat).transpose();
                Pose::from_world_to_camera(rotation, -(rotation * position))
            }
            None => Pose::look_at(position, needed("look_at", look_at)?, up.unwrap_or(DVec3::Z)),
        };
        let pose = pose.map_err(impossible)?;
        let fov = fov.unwrap_or(DEFAULT_FOV_DEGREES);
        if !(fov > 0.0 && fov < 180.0) {
            return Err(ProblemResponse::parameter("fov", format!("{fov} is not between 0 and 180 degrees")));
        }
        let (width, height) = (width.unwrap_or(DEFAULT_WIDTH), height.unwrap_or(DEFAULT_HEIGHT));
        let intrinsics =
            Intrinsics::from_horizontal_fov(fov.to_radians(), width, height).map_err(impossible)?;
        Ok(Self(View::Camera(Camera { intrinsics, pose })))
    }

    /// Reads one entry of a list of views.
    pub(super) fn from_body(list: &str, index: usize, view: ViewRequest) -> ApiResult<Self> {
        match View::try_from(view) {
            Ok(view) => Ok(Self(view)),
            Err(ViewError::Camera(error)) => Err(impossible_view(format!("{list}[{index}]: {error}"))),
            Err(error) => Err(invalid_view(format!("{list}[{index}]: {error}"))),
        }
    }

    /// Whether the dataset's cameras are needed to resolve this.
    pub(super) fn needs_cameras(&self) -> bool {
        matches!(self.0, View::Frame { .. })
    }

    /// The camera; `cameras` are the dataset's.
    pub(crate) fn resolve(self, cameras: &[NamedCamera]) -> ApiResult<Camera> {
        match self.0 {
            View::Camera(camera) => Ok(camera),
            View::Frame { name, width, height } => {
                let names: Vec<&str> = cameras.iter().map(|camera| camera.name.as_str()).collect();
                let index = find_name(&names, &name).ok_or_else(|| no_frame(&name, &names))?;
                let Camera { intrinsics, pose } = cameras[index].camera;
                let intrinsics = scaled(intrinsics, width, height).map_err(impossible)?;
                Ok(Camera { intrinsics, pose })
            }
        }
    }
}

/// A side in pixels, if it is given.
pub(crate) fn side(parameters: &mut Parameters, name: &str) -> ApiResult<Option<u32>> {
    let side = parameters.take_as::<NonZeroU32>(name, "a positive whole number of pixels")?;
    Ok(side.map(NonZeroU32::get))
}

/// The same view at another size; a side that is not given follows the other's.
pub(super) fn scaled(
    from: Intrinsics,
    width: Option<u32>,
    height: Option<u32>,
) -> Result<Intrinsics, CameraError> {
    let follow = |side: u32, num: u32, den: u32| {
        (f64::from(side) * f64::from(num) / f64::from(den)).round().clamp(1.0, f64::from(u32::MAX)) as u32
    };
    let (width, height) = match (width, height) {
        (None, None) => (from.width, from.height),
        (Some(width), None) => (width, follow(from.height, width, from.width)),
        (None, Some(height)) => (follow(from.width, height, from.height), height),
        (Some(width), Some(height)) => (width, height),
    };
    from.resized(width, height).validated()
}

pub(crate) fn impossible(error: CameraError) -> ProblemResponse {
    impossible_view(error.to_string())
}

pub(super) fn impossible_view(detail: String) -> ProblemResponse {
    ProblemType::ImpossibleView.because(detail)
}

/// 422 about a field of a view.
pub(super) fn invalid_view(detail: impl Into<String>) -> ProblemResponse {
    ProblemType::InvalidView.because(detail)
}

fn no_frame(name: &str, names: &[&str]) -> ProblemResponse {
    let some = names.iter().take(NAMES_SHOWN).copied().collect::<Vec<_>>().join(", ");
    let shown: String = name.chars().take(200).collect();
    ProblemType::FrameNotFound.because(format!(
        "no frame, or more than one, is meant by '{shown}'; the dataset has {} frames: {some}, ...",
        names.len()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scaling_keeps_what_a_pixel_sees() {
        let from = Intrinsics { fx: 100.0, fy: 90.0, cx: 33.0, cy: 20.0, width: 60, height: 40 };
        let half = scaled(from, Some(30), None).expect("a size");
        assert_eq!(half, Intrinsics { fx: 50.0, fy: 45.0, cx: 16.5, cy: 10.0, width: 30, height: 20 });
        assert_eq!(scaled(from, None, Some(80)).expect("a size").width, 120);
        assert_eq!(scaled(from, None, None), Ok(from));
        assert!(scaled(from, Some(0), None).is_err());
        assert!(scaled(from, Some(u32::MAX), None).is_err());
    }
}
