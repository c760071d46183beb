//! `tcgs decode`: a file in, its attributes and their hash out. No adapter is needed.

use std::path::PathBuf;

use serde_json::json;
use tcgs::domain::Problem;

use super::{CliError, Report, files, wiring};

/// Arguments of `tcgs decode`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The compressed file
    file: PathBuf,

    /// The tensors to write
    #[arg(short, long, value_name = "OUT.safetensors")]
    output: PathBuf,

    /// Print one JSON document
    #[arg(long)]
    pub(super) json: bool,
}

/// Decodes and writes.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let in_file = |problem: Problem| problem.in_file(args.file.display().to_string());
    files::check_output(&args.output, &args.file, &["safetensors"])?;
    let decoded = wiring::read(&files::read(&args.file)?).map_err(in_file)?;
    let bytes = wiring::tensors(&decoded).map_err(in_file)?;
    files::write(&args.output, &bytes)?;
    let (digest, output) = (decoded.decode_sha256, &args.output);
    let (anchors, gaussians) = (decoded.scene.anchors(), decoded.scene.gaussians());
    let text = format!("{digest}\n{anchors} anchors, {gaussians} Gaussians\nwrote {}", output.display());
    let json = json!({
        "decode_sha256": digest,
        "anchors": anchors,
        "gaussians": gaussians,
        "output": output,
    });
    Ok(Report::new(text, &json))
}
