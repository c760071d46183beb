//! A camera given as JSON, in the form of a view of `POST /v1/jobs/{id}/views`.

use tcgs::domain::{Camera, Problem, ProblemType, View, ViewRequest};

use super::{CliError, files};

/// The camera that `text` gives: the JSON object itself, or the name of a file that holds it.
pub(crate) fn camera(text: &str) -> Result<Camera, CliError> {
    let (source, json) = if text.trim_start().starts_with('{') {
        ("--pose".to_owned(), text.as_bytes().to_vec())
    } else {
        (text.to_owned(), files::read(text.as_ref())?)
    };
    let refuse = |detail: String| Problem::new(ProblemType::ImpossiblePose, detail).in_file(source.clone());
    let request: ViewRequest = serde_json::from_slice(&json).map_err(|error| refuse(error.to_string()))?;
    match View::try_from(request).map_err(|error| refuse(error.to_string()))? {
        View::Camera(camera) => Ok(camera),
        View::Frame { .. } => {
            Err(refuse("a frame needs its dataset: give --dataset and --frame".to_owned()).into())
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn view(convention: &str, rows: &str, fx: f64) -> String {
        format!(
            r#"{{"camera_to_world": {rows}, "convention": "{convention}",
            "fx": {fx}, "fy": 50, "cx": 16, "cy": 12, "width": 32, "height": 24}}"#
        )
    }

    const OPENCV: &str = "[[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]";
    const OPENGL: &str = "[[1,0,0,1],[0,-1,0,2],[0,0,-1,3],[0,0,0,1]]";

    #[test]
    fn both_conventions_and_both_sources_give_the_same_camera() {
        let inline = camera(&view("opencv", OPENCV, 50.0)).expect("a camera");
        assert_eq!(inline.pose.center(), DVec3::new(1.0, 2.0, 3.0));
        assert_eq!(camera(&view("opengl", OPENGL, 50.0)).expect("a camera"), inline);
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("pose.json");
        std::fs::write(&path, view("opencv", OPENCV, 50.0)).expect("writes");
        assert_eq!(camera(path.to_str().expect("UTF-8")).expect("a camera"), inline);
    }

    #[test]
    fn what_is_not_a_camera_is_refused_with_its_fault() {
        let scaled = "[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]";
        for (text, word) in [
            (view("opencv", scaled, 50.0), "rigid"),
            (view("opencv", OPENCV, 0.0), "focal"),
            (view("blender", OPENCV, 50.0), "blender"),
            (view("opencv", "[[1,0,0]]", 50.0), "length"),
            ("{}".to_owned(), "camera_to_world"),
            (r#"{"position": [1, 2, 3]}"#.to_owned(), "look_at"),
            (r#"{"frame": "view_06"}"#.to_owned(), "--dataset"),
            ("no/such/file.json".to_owned(), "no/such/file.json"),
        ] {
            let error = camera(&text).expect_err(word);
            assert!(error.to_string().contains(word), "{error}");
            assert_eq!(error.exit_status(), 3);
        }
    }
}
