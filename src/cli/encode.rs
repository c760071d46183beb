//! `tcgs encode`: decoded attributes in, one compressed file out.

use std::path::PathBuf;

use serde_json::json;
use tcgs::codec::{ContextSettings, EncodeSettings, Provenance};

use super::{CliError, Report, files, wiring};

/// Arguments of `tcgs encode`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Anchors as `tcgs decode` and `tcgs train --model scaffold` write them
    #[arg(value_name = "IN.safetensors")]
    input: PathBuf,

    /// The file to write
    #[arg(short, long, value_name = "OUT.tcgs")]
    output: PathBuf,

    /// Quantization step of features
    #[arg(long, value_name = "X", default_value_t = wiring::FEATURE_STEP, value_parser = step)]
    feature_step: f32,

    /// Quantization step of scalings, as a fraction of the voxel
    #[arg(long, value_name = "X", default_value_t = wiring::SCALING_STEP, value_parser = step)]
    scaling_step: f32,

    /// Quantization step of offsets
    #[arg(long, value_name = "X", default_value_t = wiring::OFFSET_STEP, value_parser = step)]
    offset_step: f32,
}

fn step(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err("a step is a positive number".to_owned()),
    }
}

/// Encodes and writes.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    files::check_output(&args.output, &args.input, &["tcgs"])?;
    let file = wiring::anchors(&files::read(&args.input)?)
        .map_err(|problem| problem.in_file(args.input.display().to_string()))?;
    let settings = EncodeSettings {
        background: file.background,
        feature_step: args.feature_step,
        scaling_step: args.scaling_step,
        offset_step: args.offset_step,
        context: ContextSettings::default(),
        provenance: Provenance {
            generator: concat!("tcgs ", env!("CARGO_PKG_VERSION")).to_owned(),
            dataset: file.dataset,
            adapter: None,
            settings: json!({}),
        },
    };
    let encoded = wiring::encode(&file.scene, &settings)?;
    files::write(&args.output, &encoded.bytes)?;
    Ok(Report::text(format!(
        "{} bytes, {} anchors\ndecoded {}\nwrote {}",
        encoded.bytes.len(),
        encoded.scene.len(),
        encoded.decode_sha256,
        args.output.display()
    )))
}
