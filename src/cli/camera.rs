//! The flags that name a camera: one of a dataset's, or a pose.

use std::path::PathBuf;

use tcgs::domain::{Camera, Problem, ProblemType, dataset::find_name};

use super::{CliError, pose, reading, wiring};

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
    /// The camera; that of a dataset as the training of the scene in `file` read it, if the file says how.
    pub(crate) fn camera(&self, file: &[u8]) -> Result<Camera, CliError> {
        match (&self.pose, &self.dataset, &self.frame) {
            (Some(pose), None, None) => pose::camera(pose),
            (None, Some(dataset), Some(name)) => {
                let cameras = wiring::cameras(dataset, &reading::of_scene(file))?;
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

#[cfg(test)]
mod tests {
    use std::fs;

    use tcgs::{
        codec::{ContextSettings, DecodeLimits, EncodeSettings, Provenance, decode},
        domain::{Background, MaskSource, MaxWidth, TrainOptions},
        sample,
    };

    use super::*;

    /// A scene's file that states these options.
    fn trained_with(options: &TrainOptions) -> Vec<u8> {
        let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/unit_v1.tcgs");
        let golden = fs::read(golden).expect("a file");
        let scene = decode(&golden, &DecodeLimits::default()).expect("a scene").scene;
        let provenance = Provenance {
            generator: String::new(),
            dataset: None,
            adapter: None,
            settings: serde_json::to_value(options).expect("JSON"),
        };
        let settings = EncodeSettings {
            background: Background::Black,
            feature_step: wiring::FEATURE_STEP,
            scaling_step: wiring::SCALING_STEP,
            offset_step: wiring::OFFSET_STEP,
            context: ContextSettings::default(),
            provenance,
        };
        wiring::encode(&scene, &settings).expect("encodes").bytes
    }

    #[test]
    fn cameras_are_those_that_the_scene_was_trained_with() {
        let folder = tempfile::tempdir().expect("a folder");
        let dataset = folder.path().join("scene");
        sample::write(&dataset, &sample::Settings { points: 50, ..sample::Settings::square(32) })
            .expect("writes");
        fs::create_dir(dataset.join("masks")).expect("a folder");
        fs::copy(dataset.join("images/view_01.png"), dataset.join("masks/of_nothing.png")).expect("copies");
        let flags = CameraFlags { dataset: Some(dataset), frame: Some("view_01.png".to_owned()), pose: None };
        let refused = flags.camera(&trained_with(&TrainOptions::default())).expect_err("refused");
        assert!(refused.to_string().contains("masks=none"), "{refused}");
        let max_width = MaxWidth::new(16).expect("a width");
        let options = TrainOptions { masks: MaskSource::None, max_width, ..TrainOptions::default() };
        let camera = flags.camera(&trained_with(&options)).expect("a camera");
        assert_eq!(camera.intrinsics.width, 16);
    }
}
