//! The flags that name a camera: one of a dataset's, or a pose.

use std::path::PathBuf;

use tcgs::domain::{Camera, Problem, ProblemType, dataset::find_name};

use super::{CliError, pose, wiring};

/// Which camera to render from.
#[derive(Debug, clap::Args)]
#[group(skip)]
#[command(group = clap::ArgGroup::new("camera").required(true).args(["frame", "pose"]))]
pub(crate) struct CameraFlags {
    /// The dataset that names the camera
    #[arg(long, requires = "frame")]
    dataset: Option<PathBuf>,

    /// Name of the dataset's image whose camera to use
    #[arg(long, value_name = "NAME", requires = "dataset")]
    frame: Option<String>,

    /// A camera as a JSON object or a file that holds one: camera_to_world (4 rows), convention (opencv or opengl;
    /// opencv if absent), fx, fy (fx), cx, cy (the middle), width, height
    #[arg(long, value_name = "JSON", conflicts_with = "dataset")]
    pose: Option<String>,
}

impl CameraFlags {
    /// The camera.
    pub(crate) fn camera(&self) -> Result<Camera, CliError> {
        match (&self.pose, &self.dataset, &self.frame) {
            (Some(pose), None, None) => pose::camera(pose),
            (None, Some(dataset), Some(name)) => {
                let cameras = wiring::cameras(dataset)?;
                let names: Vec<&str> = cameras.iter().map(|camera| camera.name.as_str()).collect();
                let index = find_name(&names, name).ok_or_else(|| {
                    let first = names.first().unwrap_or(&"");
                    let detail = format!("the dataset has no frame '{name}'; its first is '{first}'");
                    Problem::new(ProblemType::UnknownFrame, detail)
                })?;
                Ok(cameras[index].camera)
            }
            _ => Err(CliError::Usage("give --pose, or --dataset and --frame".to_owned())),
        }
    }
}
