//! `tcgs inspect`: where each byte of a file goes.

use std::path::PathBuf;

use serde_json::{Value, json};
use tcgs::domain::{Problem, SceneFormat};

use super::{CliError, Report, files, wiring};

/// Arguments of `tcgs inspect`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A .tcgs file, the .safetensors or .ply of a baseline, or a .spz
    file: PathBuf,

    /// Print one JSON document
    #[arg(long)]
    pub(super) json: bool,
}

/// Accounts for the file.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let bytes = files::read(&args.file)?;
    let in_file = |problem: Problem| problem.in_file(args.file.display().to_string());
    match SceneFormat::of_bytes(&bytes) {
        SceneFormat::Tcgs => {
            let inspection = wiring::inspect(&bytes).map_err(in_file)?;
            Ok(Report { text: inspection.text, json: inspection.json })
        }
        _ => {
            let file = wiring::read(&bytes).map_err(in_file)?;
            Ok(Report::new(text(&file), &account(&file)))
        }
    }
}

/// What there is to say of a file that is no .tcgs.
fn account(file: &wiring::SceneFile) -> Value {
    json!({
        "format": file.format,
        "anchors": file.scene.anchors(),
        "gaussians": file.scene.gaussians(),
        "background": file.background,
        "dataset": file.dataset,
        "decode_sha256": file.decode_sha256,
        "byte_counts": file.byte_counts,
    })
}

fn text(file: &wiring::SceneFile) -> String {
    let counts = &file.byte_counts;
    let mut text = format!(
        ".{}, {} bytes\n\nanchors     {}\ngaussians   {}\nbackground  {}\ndecoded     {}\n\nbytes by part\n",
        file.format.name(),
        counts.total,
        file.scene.anchors(),
        file.scene.gaussians(),
        file.background,
        file.decode_sha256,
    );
    for (part, bytes) in counts.parts() {
        let share = 100.0 * bytes as f64 / counts.total.max(1) as f64;
        text.push_str(&format!("{part:<11} {bytes:>10} {share:>6.2}%\n"));
    }
    text
}
