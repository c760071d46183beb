//! Reads cameras from requests: a dataset frame by name, a look-at view, or a pose matrix.

use std::num::NonZeroU32;

use crate::{
    domain::{
        Camera, CameraError, Intrinsics, NamedCamera, ProblemType, View, ViewError, ViewRequest,
        dataset::find_name,
    },
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        request::Parameters,
    },
};

/// Frame names in the problem of an unknown one.
const NAMES_SHOWN: usize = 3;

/// A requested camera, before the dataset's cameras are read.
#[derive(Debug)]
pub(crate) enum CameraSpec {
    View(View),
    /// The first to show ([`NamedCamera::first_to_show`]), at another size if one is given.
    First {
        width: Option<u32>,
        height: Option<u32>,
    },
}

impl CameraSpec {
    /// Takes `frame`, `position`, `look_at`, `up`, `quat`, `fov`, `width` and `height` of a query.
    pub(crate) fn take(parameters: &mut Parameters) -> ApiResult<ViewRequest> {
        Ok(ViewRequest {
            width: side(parameters, "width")?,
            height: side(parameters, "height")?,
            position: parameters.take_numbers("position", "three finite numbers x,y,z")?,
            look_at: parameters.take_numbers("look_at", "three finite numbers x,y,z")?,
            up: parameters.take_numbers("up", "three finite numbers x,y,z")?,
            quat: parameters.take_numbers("quat", "four finite numbers w,x,y,z")?,
            fov: parameters.take_as("fov", "a number of degrees")?,
            frame: parameters.take("frame"),
            ..ViewRequest::default()
        })
    }

    /// The camera of a query. Without one it is the first to show.
    pub(crate) fn from_query(request: ViewRequest) -> ApiResult<Self> {
        if request.names_no_camera() {
            let ViewRequest { width, height, .. } = request;
            return Ok(Self::First { width, height });
        }
        View::try_from(request).map(Self::View).map_err(|error| match (&error, error.field()) {
            (ViewError::Camera(error), _) => impossible_view(error.to_string()),
            (_, Some((field, fault))) => ProblemResponse::parameter(field, fault),
            (error, None) => invalid_view(error.to_string()),
        })
    }

    /// Reads one entry of a list of views.
    pub(super) fn from_body(list: &str, index: usize, view: ViewRequest) -> ApiResult<Self> {
        match View::try_from(view) {
            Ok(view) => Ok(Self::View(view)),
            Err(ViewError::Camera(error)) => Err(impossible_view(format!("{list}[{index}]: {error}"))),
            Err(error) => Err(invalid_view(format!("{list}[{index}]: {error}"))),
        }
    }

    /// Whether the dataset's cameras are needed to resolve this.
    pub(super) fn needs_cameras(&self) -> bool {
        !matches!(self, Self::View(View::Camera(_)))
    }

    /// The camera; `cameras` are the dataset's.
    pub(crate) fn resolve(self, cameras: &[NamedCamera]) -> ApiResult<Camera> {
        let (shown, width, height) = match self {
            Self::View(View::Camera(camera)) => return Ok(camera),
            Self::View(View::Frame { name, width, height }) => (named(&name, cameras)?, width, height),
            Self::First { width, height } => {
                (NamedCamera::first_to_show(cameras).ok_or_else(no_cameras)?, width, height)
            }
        };
        let Camera { intrinsics, pose } = shown.camera;
        let intrinsics = scaled(intrinsics, width, height).map_err(impossible)?;
        Ok(Camera { intrinsics, pose })
    }
}

/// The dataset's camera of this name.
fn named<'a>(name: &str, cameras: &'a [NamedCamera]) -> ApiResult<&'a NamedCamera> {
    let names: Vec<&str> = cameras.iter().map(|camera| camera.name.as_str()).collect();
    let index = find_name(&names, name).ok_or_else(|| no_frame(name, &names))?;
    Ok(&cameras[index])
}

fn no_cameras() -> ProblemResponse {
    impossible_view("the dataset has no cameras; give position and look_at".to_owned())
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
