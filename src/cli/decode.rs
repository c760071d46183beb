//! `tcgs decode`: a file in, its attributes and their hash out. No adapter is needed.

use std::path::PathBuf;

use serde::Serialize;
use tcgs::domain::{Digest, Problem};

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

#[derive(Debug, Serialize)]
struct Summary {
    decode_sha256: Digest,
    anchors: usize,
    gaussians: usize,
    output: PathBuf,
}

/// Decodes and writes.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let in_file = |problem: Problem| problem.in_file(args.file.display().to_string());
    let decoded = wiring::read(&files::read(&args.file)?).map_err(in_file)?;
    let bytes = wiring::tensors(&decoded).map_err(in_file)?;
    files::write(&args.output, &bytes)?;
    let summary = Summary {
        decode_sha256: decoded.decode_sha256,
        anchors: decoded.scene.anchors(),
        gaussians: decoded.scene.gaussians(),
        output: args.output.clone(),
    };
    let text = format!(
        "{}\n{} anchors, {} Gaussians\nwrote {}",
        summary.decode_sha256,
        summary.anchors,
        summary.gaussians,
        summary.output.display()
    );
    Ok(Report::new(text, &summary))
}
