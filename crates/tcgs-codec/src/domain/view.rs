//! A requested view: the name of a dataset frame, a position with a direction, or a matrix with intrinsics. It is the same in JSON over
//! HTTP, in queries and on the command line.

use glam::{DMat3, DMat4, DQuat, DVec3, DVec4};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{Camera, CameraError, Convention, Intrinsics, Pose};

const DEFAULT_FOV_DEGREES: f64 = 60.0;
const DEFAULT_WIDTH: u32 = 640;
const DEFAULT_HEIGHT: u32 = 480;

/// The fields of a view, of one of three forms:
///
/// - `frame`, alone or with a size;
/// - `position` with either `look_at` and `up` or `quat`, `fov` and a size;
/// - `camera_to_world`, `fx`, `width` and `height`. Then `fy` is `fx` and the principal point the middle of the image unless they are
///   given.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewRequest {
    /// Name of a dataset image.
    pub frame: Option<String>,
    /// The camera's center.
    pub position: Option<[f64; 3]>,
    /// The point in the middle of the image.
    pub look_at: Option<[f64; 3]>,
    /// The direction towards the image's top; the z axis if absent.
    pub up: Option<[f64; 3]>,
    /// The rotation from camera axes to the world as a quaternion w, x, y, z of any length but 0.
    pub quat: Option<[f64; 4]>,
    /// Horizontal field of view in degrees; 60 if absent.
    pub fov: Option<f64>,
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

/// A camera in the form that a [`ViewRequest`] takes, by its matrix.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraView {
    camera_to_world: [[f64; 4]; 4],
    convention: Convention,
    #[serde(flatten)]
    intrinsics: Intrinsics,
}

impl From<&Camera> for CameraView {
    fn from(camera: &Camera) -> Self {
        let convention = Convention::Opencv;
        let matrix = camera.pose.camera_to_world(convention);
        let camera_to_world = std::array::from_fn(|row| matrix.row(row).to_array());
        Self { camera_to_world, convention, intrinsics: camera.intrinsics }
    }
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
    /// It has none of the fields that begin a view.
    #[error("frame, position or camera_to_world is needed")]
    NoCamera,
    /// A field that another requires is absent.
    #[error("{field} is needed with {with}")]
    Missing {
        /// The absent field.
        field: &'static str,
        /// The field that is there.
        with: &'static str,
    },
    /// Two fields that exclude each other.
    #[error("{field} cannot be combined with {with}")]
    Excluded {
        /// The field too many.
        field: &'static str,
        /// The field that excludes it.
        with: &'static str,
    },
    /// A value out of range.
    #[error("{field} {error}")]
    Invalid {
        /// The field.
        field: &'static str,
        /// What is wrong with its value, as a predicate.
        error: String,
    },
    /// The values do not describe a camera.
    #[error(transparent)]
    Camera(#[from] CameraError),
}

impl ViewError {
    /// The field at fault, if there is a single one, and what is wrong with it.
    #[must_use]
    pub fn field(&self) -> Option<(&'static str, String)> {
        match self {
            Self::NoCamera => Some(("position", "is needed, unless frame names a dataset camera".to_owned())),
            Self::Missing { field, with } => Some((field, format!("is needed with {with}"))),
            Self::Excluded { field, with } => Some((field, format!("cannot be combined with {with}"))),
            Self::Invalid { field, error } => Some((field, error.clone())),
            Self::Camera(_) => None,
        }
    }
}

impl ViewRequest {
    /// Names of the fields besides the size that are given.
    fn given(&self) -> Vec<&'static str> {
        let fields = [
            ("frame", self.frame.is_some()),
            ("position", self.position.is_some()),
            ("camera_to_world", self.camera_to_world.is_some()),
            ("look_at", self.look_at.is_some()),
            ("up", self.up.is_some()),
            ("quat", self.quat.is_some()),
            ("fov", self.fov.is_some()),
            ("convention", self.convention.is_some()),
            ("fx", self.fx.is_some()),
            ("fy", self.fy.is_some()),
            ("cx", self.cx.is_some()),
            ("cy", self.cy.is_some()),
        ];
        fields.into_iter().filter(|(_, is_given)| *is_given).map(|(name, _)| name).collect()
    }

    /// Whether no field but the size is given.
    #[must_use]
    pub fn names_no_camera(&self) -> bool {
        self.given().is_empty()
    }

    /// Refuses fields besides `form` and those in `allowed`.
    fn only(&self, form: &'static str, allowed: &[&str]) -> Result<(), ViewError> {
        let is_foreign = |field: &&str| *field != form && !allowed.contains(field);
        match self.given().into_iter().find(is_foreign) {
            Some(field) => Err(ViewError::Excluded { field, with: form }),
            None => Ok(()),
        }
    }

    fn at_position(&self, position: DVec3) -> Result<Camera, ViewError> {
        const FORM: &str = "position";
        let pose = match self.quat {
            Some([w, x, y, z]) => {
                for (field, value) in [("look_at", self.look_at), ("up", self.up)] {
                    if value.is_some() {
                        return Err(ViewError::Excluded { field, with: "quat" });
                    }
                }
                let turn = DVec4::new(x, y, z, w).try_normalize();
                let no_length = || ViewError::Invalid { field: "quat", error: "has no length".to_owned() };
                let rotation = DMat3::from_quat(DQuat::from_vec4(turn.ok_or_else(no_length)?)).transpose();
                Pose::from_world_to_camera(rotation, -(rotation * position))?
            }
            None => {
                let look_at = self.look_at.ok_or(ViewError::Missing { field: "look_at", with: FORM })?;
                let up = self.up.map_or(DVec3::Z, DVec3::from_array);
                Pose::look_at(position, DVec3::from_array(look_at), up)?
            }
        };
        let fov = self.fov.unwrap_or(DEFAULT_FOV_DEGREES);
        if !(fov > 0.0 && fov < 180.0) {
            let error = format!("{fov} is not between 0 and 180 degrees");
            return Err(ViewError::Invalid { field: "fov", error });
        }
        let (width, height) = (self.width.unwrap_or(DEFAULT_WIDTH), self.height.unwrap_or(DEFAULT_HEIGHT));
        let intrinsics = Intrinsics::from_horizontal_fov(fov.to_radians(), width, height)?;
        Ok(Camera { intrinsics, pose })
    }

    fn of_matrix(&self, rows: &[[f64; 4]; 4]) -> Result<Camera, ViewError> {
        let missing = |field| ViewError::Missing { field, with: "camera_to_world" };
        let fx = self.fx.ok_or_else(|| missing("fx"))?;
        let width = self.width.ok_or_else(|| missing("width"))?;
        let height = self.height.ok_or_else(|| missing("height"))?;
        let matrix = DMat4::from_cols_array_2d(rows).transpose();
        let pose = Pose::from_camera_to_world(matrix, self.convention.unwrap_or_default())?;
        let intrinsics = Intrinsics {
            fx,
            fy: self.fy.unwrap_or(fx),
            cx: self.cx.unwrap_or(f64::from(width) / 2.0),
            cy: self.cy.unwrap_or(f64::from(height) / 2.0),
            width,
            height,
        };
        Ok(Camera::new(intrinsics, pose)?)
    }
}

impl TryFrom<ViewRequest> for View {
    type Error = ViewError;

    fn try_from(request: ViewRequest) -> Result<Self, ViewError> {
        let (width, height) = (request.width, request.height);
        if let Some(name) = &request.frame {
            request.only("frame", &[])?;
            return Ok(Self::Frame { name: name.clone(), width, height });
        }
        if let Some(position) = request.position {
            request.only("position", &["look_at", "up", "quat", "fov"])?;
            return request.at_position(DVec3::from_array(position)).map(Self::Camera);
        }
        if let Some(rows) = request.camera_to_world {
            request.only("camera_to_world", &["convention", "fx", "fy", "cx", "cy"])?;
            return request.of_matrix(&rows).map(Self::Camera);
        }
        match request.given().first() {
            None => Err(ViewError::NoCamera),
            Some(with) => {
                let of_position = ["look_at", "up", "quat", "fov"].contains(with);
                let field = if of_position { "position" } else { "camera_to_world" };
                Err(ViewError::Missing { field, with })
            }
        }
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
        assert_eq!(
            view(r#"{"frame": "a", "fy": 8}"#),
            Err(ViewError::Excluded { field: "fy", with: "frame" })
        );
    }

    #[test]
    fn a_position_means_what_its_matrix_means() {
        let at = camera(
            r#"{"position": [4, 0, 0], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 60, "width": 640, "height": 480}"#,
        );
        assert_eq!(camera(r#"{"position": [4, 0, 0], "look_at": [0, 0, 0]}"#), at, "the defaults");
        let matrix = r#""camera_to_world": [[0,0,-1,4],[1,0,0,0],[0,-1,0,0],[0,0,0,1]]"#;
        let same = camera(&format!(r#"{{{matrix}, "fx": 554.2562584220407, "width": 640, "height": 480}}"#));
        assert!((at.intrinsics.fx - same.intrinsics.fx).abs() < 1e-9);
        assert!(at.pose.center().distance(same.pose.center()) < 1e-12);
        let turned = camera(r#"{"position": [4, 0, 0], "quat": [-1, 1, 1, -1]}"#);
        let deviation = turned.pose.rotation() - at.pose.rotation();
        assert!(deviation.to_cols_array().iter().all(|entry| entry.abs() < 1e-12), "{turned:?}");
    }

    #[test]
    fn what_is_no_view_is_refused_with_its_fault() {
        let missing = |field, with| Err(ViewError::Missing { field, with });
        let excluded = |field, with| Err(ViewError::Excluded { field, with });
        assert_eq!(view("{}"), Err(ViewError::NoCamera));
        assert_eq!(view(r#"{"width": 4}"#), Err(ViewError::NoCamera));
        assert_eq!(view(&format!("{{{POSE}}}")), missing("fx", "camera_to_world"));
        assert_eq!(view(&format!(r#"{{{POSE}, "fx": 1}}"#)), missing("width", "camera_to_world"));
        assert_eq!(view(r#"{"fx": 1}"#), missing("camera_to_world", "fx"));
        assert_eq!(view(r#"{"look_at": [0, 0, 0]}"#), missing("position", "look_at"));
        let at = r#""position": [1, 2, 3]"#;
        assert_eq!(view(&format!("{{{at}}}")), missing("look_at", "position"));
        assert_eq!(view(&format!(r#"{{{at}, "frame": "a"}}"#)), excluded("position", "frame"));
        assert_eq!(view(&format!(r#"{{{at}, {POSE}}}"#)), excluded("camera_to_world", "position"));
        let both = view(&format!(r#"{{{at}, "quat": [1, 0, 0, 0], "up": [0, 0, 1]}}"#));
        assert_eq!(both, excluded("up", "quat"));
        for (fields, field) in
            [(r#""quat": [0, 0, 0, 0]"#, "quat"), (r#""look_at": [0, 0, 0], "fov": 180"#, "fov")]
        {
            let error = view(&format!("{{{at}, {fields}}}")).expect_err(field);
            assert_eq!(error.field().map(|(field, _)| field), Some(field), "{error}");
        }
        let flat = view(&format!(r#"{{{POSE}, "fx": 0, "width": 1, "height": 1}}"#));
        assert_eq!(flat, Err(ViewError::Camera(CameraError::FocalLength(0.0))));
    }
}
