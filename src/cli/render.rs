//! `tcgs render`: one view of a file, from a dataset's camera or from a pose.

use std::path::PathBuf;

use tcgs::domain::{Camera, Problem, ProblemType};

use super::{CliError, Report, adapter::AdapterFlag, files, picture, pose, wiring};

/// Arguments of `tcgs render`.
#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("camera").required(true).args(["frame", "pose"]))]
pub(crate) struct Args {
    /// A .tcgs file, the .safetensors or .ply of a baseline, or a .spz
    file: PathBuf,

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

    /// The image to write: .png, .jpg or .webp
    #[arg(short, long, value_name = "OUT.png")]
    output: PathBuf,

    #[command(flatten)]
    adapter: AdapterFlag,
}

impl Args {
    fn camera(&self) -> Result<Camera, CliError> {
        match (&self.pose, &self.dataset, &self.frame) {
            (Some(pose), None, None) => pose::camera(pose),
            (None, Some(dataset), Some(name)) => {
                let dataset = wiring::load_dataset(dataset)?;
                let frame = dataset.find_frame(name).ok_or_else(|| {
                    let first = dataset.frames.first().map_or("", |frame| frame.name.as_str());
                    let detail = format!("the dataset has no frame '{name}'; its first is '{first}'");
                    Problem::new(ProblemType::UnknownFrame, detail)
                })?;
                Ok(frame.camera)
            }
            _ => Err(CliError::Usage("give --pose, or --dataset and --frame".to_owned())),
        }
    }
}

/// Renders and writes.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    picture::format_of(&args.output)?;
    let camera = args.camera()?;
    let decoded = wiring::read(&files::read(&args.file)?)
        .map_err(|problem| problem.in_file(args.file.display().to_string()))?;
    let renderer = wiring::Renderer::open(decoded, &args.adapter.adapter)?;
    picture::write(&args.output, &renderer.view(&camera)?)?;
    Ok(Report::text(format!("wrote {}", args.output.display())))
}
