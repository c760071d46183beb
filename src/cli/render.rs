//! `tcgs render`: one view of a file, from a dataset's camera or from a pose.

use std::path::PathBuf;

use super::{CliError, Report, adapter::AdapterFlag, camera::CameraFlags, files, picture, wiring};

/// Arguments of `tcgs render`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A .tcgs file, the .safetensors or .ply of a baseline, or a .spz
    file: PathBuf,

    #[command(flatten)]
    camera: CameraFlags,

    /// The image to write: .png, .jpg or .webp
    #[arg(short, long, value_name = "OUT.png")]
    output: PathBuf,

    #[command(flatten)]
    adapter: AdapterFlag,
}

/// Renders and writes.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    picture::format_of(&args.output)?;
    files::check_writable(&args.output)?;
    let bytes = files::read(&args.file)?;
    let camera = args.camera.camera(&bytes)?;
    let decoded = wiring::read(&bytes).map_err(|problem| problem.in_file(args.file.display().to_string()))?;
    let renderer = wiring::SceneViews::open(decoded, &args.adapter.adapter)?;
    picture::write(&args.output, &renderer.view(&camera)?)?;
    Ok(Report::text(format!("wrote {}", args.output.display())))
}
