//! A view in JSON, over HTTP and on the command line: the name of a dataset frame, or a pose with intrinsics.

use glam::DMat4;
use serde::Deserialize;
use thiserror::Error;

use super::{Camera, CameraError, Convention, Intrinsics, Pose};

/// The JSON object. Either `frame`, alone or with a size, or `camera_to_world`, `fx`, `width` and `height`; then `fy`
/// is `fx` and the principal point the middle of the image unless they are given.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewRequest {
    /// Name of a dataset image.
    pub frame: Option<String>,
    /// Four rows of a rigid motion.
    pub camera_to_world: Option<[[f64; 4]; 4]>,
    /// Axes of the camera; OpenCV's if absent.
    pub convention: Option<Convention>,
    /// Horizontal focal length in pixels.
    pub fx: Option<f64>,
    /// Vertical focal length in pixels.
    pub fy: Option<f64>,
    /// Principal point in pixels, horizontal.
    pub cx: Option<f64>,
    /// Principal point in pixels, vertical.
    pub cy: Option<f64>,
    /// Width in pixels.
    pub width: Option<u32>,
    /// Height in pixels.
    pub height: Option<u32>,
}

/// What a [`ViewRequest`] asks for.
#[derive(Debug, Clone, PartialEq)]
pub enum View {
    /// A dataset camera, at another size if one is given.
    Frame {
        /// Name of the frame.
        name: String,
        /// Wanted width in pixels.
        width: Option<u32>,
        /// Wanted height in pixels.
        height: Option<u32>,
    },
    /// A camera of its own.
    Camera(Camera),
}

/// Why a [`ViewRequest`] is not a view.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ViewError {
    /// A field that the others require is absent.
    #[error("{0} is needed, unless frame is given")]
    Missing(&'static str),
    /// A field that the frame determines.
    #[error("a frame has its own pose and intrinsics; give only width and height with it, not {0}")]
    NotWithFrame(&'static str),
    /// The values do not describe a camera.
    #[error(transparent)]
    Camera(#[from] CameraError),
}

impl TryFrom<ViewRequest> for View {
    type Error = ViewError;

    fn try_from(request: ViewRequest) -> Result<Self, ViewError> {
        let ViewRequest { frame, camera_to_world, convention, fx, fy, cx, cy, width, height } = request;
        if let Some(name) = frame {
            let given = [
                ("camera_to_world", camera_to_world.is_some()),
                ("convention", convention.is_some()),
                ("fx", fx.is_some()),
                ("fy", fy.is_some()),
                ("cx", cx.is_some()),
                ("cy", cy.is_some()),
            ];
            return match given.iter().find(|(_, is_given)| *is_given) {
                Some((field, _)) => Err(ViewError::NotWithFrame(field)),
                None => Ok(Self::Frame { name, width, height }),
            };
        }
        let rows = camera_to_world.ok_or(ViewError::Missing("camera_to_world"))?;
        let fx = fx.ok_or(ViewError::Missing("fx"))?;
        let width = width.ok_or(ViewError::Missing("width"))?;
        let height = height.ok_or(ViewError::Missing("height"))?;
        let matrix = DMat4::from_cols_array_2d(&rows).transpose();
        let pose = Pose::from_camera_to_world(matrix, convention.unwrap_or_default())?;
        let intrinsics = Intrinsics {
            fx,
            fy: fy.unwrap_or(fx),
            cx: cx.unwrap_or(f64::from(width) / 2.0),
            cy: cy.unwrap_or(f64::from(height) / 2.0),
            width,
            height,
        };
        Ok(Self::Camera(Camera::new(intrinsics, pose)?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(json: &str) -> Result<View, ViewError> {
        serde_json::from_str::<ViewRequest>(json).expect("a request").try_into()
    }

    fn camera(json: &str) -> Camera {
        match view(json).expect("a view") {
            View::Camera(camera) => camera,
            View::Frame { name, .. } => panic!("frame {name}"),
        }
    }

    const POSE: &str = r#""camera_to_world": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]"#;
    const FLIPPED: &str = r#""camera_to_world": [[1,0,0,1],[0,-1,0,2],[0,0,-1,3],[0,0,0,1]]"#;

    #[test]
    fn both_conventions_describe_one_camera_and_what_is_absent_has_a_meaning() {
        let plain = camera(&format!(r#"{{{POSE}, "fx": 50, "width": 32, "height": 24}}"#));
        assert_eq!(plain.pose.center(), glam::DVec3::new(1.0, 2.0, 3.0));
        let k = Intrinsics { fx: 50.0, fy: 50.0, cx: 16.0, cy: 12.0, width: 32, height: 24 };
        assert_eq!(plain.intrinsics, k);
        let all = r#""fx": 50, "fy": 50, "cx": 16, "cy": 12, "width": 32, "height": 24"#;
        assert_eq!(camera(&format!(r#"{{{POSE}, "convention": "opencv", {all}}}"#)), plain);
        assert_eq!(camera(&format!(r#"{{{FLIPPED}, "convention": "opengl", {all}}}"#)), plain);
    }

    #[test]
    fn a_frame_takes_a_size_and_nothing_else() {
        let frame = View::Frame { name: "a".to_owned(), width: Some(8), height: None };
        assert_eq!(view(r#"{"frame": "a", "width": 8}"#), Ok(frame));
        assert_eq!(view(r#"{"frame": "a", "fy": 8}"#), Err(ViewError::NotWithFrame("fy")));
    }

    #[test]
    fn what_is_no_view_is_refused_with_its_fault() {
        assert_eq!(view("{}"), Err(ViewError::Missing("camera_to_world")));
        assert_eq!(view(&format!("{{{POSE}}}")), Err(ViewError::Missing("fx")));
        assert_eq!(view(&format!(r#"{{{POSE}, "fx": 1}}"#)), Err(ViewError::Missing("width")));
        let flat = view(&format!(r#"{{{POSE}, "fx": 0, "width": 1, "height": 1}}"#));
        assert_eq!(flat, Err(ViewError::Camera(CameraError::FocalLength(0.0))));
    }
}
