//! From what a client writes to a [`Camera`]: a dataset frame by name, a look-at view, or a pose matrix.

use axum::http::StatusCode;
use glam::{DMat4, DVec3};
use serde::Deserialize;

use super::{problem::Fault, query::Parameters};
use crate::domain::{Camera, CameraError, Convention, Intrinsics, NamedCamera, Pose, scene::find_name};

const DEFAULT_FOV_DEGREES: f64 = 60.0;
const DEFAULT_WIDTH: u32 = 640;
const DEFAULT_HEIGHT: u32 = 480;
/// How many frame names an unknown one is answered with.
const NAMES_SHOWN: usize = 3;

/// One view of a `POST .../views` body.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ViewBody {
    frame: Option<String>,
    camera_to_world: Option<[[f64; 4]; 4]>,
    convention: Option<Convention>,
    fx: Option<f64>,
    fy: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    width: Option<u32>,
    height: Option<u32>,
}

/// What a client asked for, before the dataset's cameras are at hand.
#[derive(Debug)]
pub(super) enum CameraSpec {
    Frame { name: String, width: Option<u32>, height: Option<u32> },
    Given(Camera),
}

impl CameraSpec {
    /// Reads `frame` or `position`, `look_at`, `up`, `fov`, and `width`, `height`.
    pub(super) fn from_query(parameters: &mut Parameters) -> Result<Self, Fault> {
        let width = parameters.take_as("width", "a whole number of pixels")?;
        let height = parameters.take_as("height", "a whole number of pixels")?;
        let position = parameters.take_vector("position")?;
        let look_at = parameters.take_vector("look_at")?;
        let up = parameters.take_vector("up")?;
        let fov: Option<f64> = parameters.take_as("fov", "a number of degrees")?;
        if let Some(name) = parameters.take("frame") {
            let given =
                [("position", position), ("look_at", look_at), ("up", up), ("fov", fov.map(DVec3::splat))];
            if let Some((other, _)) = given.iter().find(|(_, value)| value.is_some()) {
                return Err(Fault::parameter(
                    other,
                    "cannot be combined with frame, which has its own camera",
                ));
            }
            return Ok(Self::Frame { name, width, height });
        }
        let needed = |name, value: Option<DVec3>| {
            value.ok_or_else(|| Fault::parameter(name, "is needed, unless frame names a dataset camera"))
        };
        let (position, look_at) = (needed("position", position)?, needed("look_at", look_at)?);
        let pose = Pose::look_at(position, look_at, up.unwrap_or(DVec3::Z)).map_err(impossible)?;
        let fov = fov.unwrap_or(DEFAULT_FOV_DEGREES);
        if !(fov > 0.0 && fov < 180.0) {
            return Err(Fault::parameter("fov", format!("{fov} is not between 0 and 180 degrees")));
        }
        let (width, height) = (width.unwrap_or(DEFAULT_WIDTH), height.unwrap_or(DEFAULT_HEIGHT));
        let intrinsics =
            Intrinsics::from_horizontal_fov(fov.to_radians(), width, height).map_err(impossible)?;
        Ok(Self::Given(Camera { intrinsics, pose }))
    }

    /// Reads one entry of `views`.
    pub(super) fn from_body(index: usize, view: ViewBody) -> Result<Self, Fault> {
        let at = |field: &str| format!("views[{index}].{field}");
        let ViewBody { frame, camera_to_world, convention, fx, fy, cx, cy, width, height } = view;
        if let Some(name) = frame {
            let has_pose = camera_to_world.is_some() || convention.is_some();
            if has_pose || [fx, fy, cx, cy].iter().any(Option::is_some) {
                return Err(invalid_view(format!(
                    "{}: a frame has its own pose and intrinsics; give only width and height with it",
                    at("frame")
                )));
            }
            return Ok(Self::Frame { name, width, height });
        }
        let missing = |field: &str| invalid_view(format!("{}: is needed, unless frame is given", at(field)));
        let rows = camera_to_world.ok_or_else(|| missing("camera_to_world"))?;
        let matrix = DMat4::from_cols_array_2d(&rows).transpose();
        let impossible_here = |error: CameraError| impossible_view(format!("views[{index}]: {error}"));
        let pose =
            Pose::from_camera_to_world(matrix, convention.unwrap_or_default()).map_err(impossible_here)?;
        let fx = fx.ok_or_else(|| missing("fx"))?;
        let width = width.ok_or_else(|| missing("width"))?;
        let height = height.ok_or_else(|| missing("height"))?;
        let intrinsics = Intrinsics {
            fx,
            fy: fy.unwrap_or(fx),
            cx: cx.unwrap_or(f64::from(width) / 2.0),
            cy: cy.unwrap_or(f64::from(height) / 2.0),
            width,
            height,
        };
        Camera::new(intrinsics, pose).map(Self::Given).map_err(impossible_here)
    }

    /// Whether the dataset's cameras are needed to resolve this.
    pub(super) fn needs_cameras(&self) -> bool {
        matches!(self, Self::Frame { .. })
    }

    /// The camera that is meant.
    pub(super) fn resolve(self, cameras: &[NamedCamera]) -> Result<Camera, Fault> {
        match self {
            Self::Given(camera) => Ok(camera),
            Self::Frame { name, width, height } => {
                let names: Vec<&str> = cameras.iter().map(|camera| camera.name.as_str()).collect();
                let index = find_name(&names, &name).ok_or_else(|| no_frame(&name, &names))?;
                let Camera { intrinsics, pose } = cameras[index].camera;
                let intrinsics = scaled(intrinsics, width, height).map_err(impossible)?;
                Ok(Camera { intrinsics, pose })
            }
        }
    }
}

/// The same view at another size. Pixel centres lie at +0.5, so everything scales by plain factors; a side that is not
/// given follows the other's.
fn scaled(from: Intrinsics, width: Option<u32>, height: Option<u32>) -> Result<Intrinsics, CameraError> {
    let follow = |side: u32, num: u32, den: u32| {
        (f64::from(side) * f64::from(num) / f64::from(den)).round().clamp(1.0, f64::from(u32::MAX)) as u32
    };
    let (width, height) = match (width, height) {
        (None, None) => (from.width, from.height),
        (Some(width), None) => (width, follow(from.height, width, from.width)),
        (None, Some(height)) => (follow(from.width, height, from.height), height),
        (Some(width), Some(height)) => (width, height),
    };
    let (x, y) = (f64::from(width) / f64::from(from.width), f64::from(height) / f64::from(from.height));
    let intrinsics =
        Intrinsics { fx: from.fx * x, fy: from.fy * y, cx: from.cx * x, cy: from.cy * y, width, height };
    intrinsics.validated()
}

fn impossible(error: CameraError) -> Fault {
    impossible_view(error.to_string())
}

fn impossible_view(detail: String) -> Fault {
    Fault::new(StatusCode::UNPROCESSABLE_ENTITY, "impossible-view", "Impossible view", detail)
}

/// 422 about a field of a view.
pub(super) fn invalid_view(detail: impl Into<String>) -> Fault {
    Fault::new(StatusCode::UNPROCESSABLE_ENTITY, "invalid-view", "Invalid view", detail)
}

fn no_frame(name: &str, names: &[&str]) -> Fault {
    let some = names.iter().take(NAMES_SHOWN).copied().collect::<Vec<_>>().join(", ");
    let shown: String = name.chars().take(200).collect();
    Fault::new(
        StatusCode::NOT_FOUND,
        "frame-not-found",
        "No such frame",
        format!(
            "no frame, or more than one, is meant by '{shown}'; the dataset has {} frames: {some}, ...",
            names.len()
        ),
    )
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
