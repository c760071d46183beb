//! `tcgs sample`: the bundled scene as a dataset.

use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};
use tcgs::{
    domain::{Problem, ProblemType},
    sample::{self, SampleError, Settings},
};

use super::{CliError, Report};

/// Arguments of `tcgs sample`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A new folder, or a new file whose name ends in .zip
    #[arg(value_name = "DIR")]
    path: PathBuf,

    /// Width and height of each image in pixels
    #[arg(long, value_name = "N", default_value_t = Settings::default().side, value_parser = clap::value_parser!(u32).range(8..=4096))]
    side: u32,

    /// Seed of the point cloud
    #[arg(long, value_name = "N", default_value_t = Settings::default().seed)]
    seed: u64,
}

/// Renders and writes the scene.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let settings = Settings { side: args.side, seed: args.seed, ..Settings::default() };
    // Hidden where standard error is no terminal.
    let bar = ProgressBar::new(0).with_message("images").with_style(style());
    let written = sample::write_watched(&args.path, &settings, &mut |drawn, all| {
        bar.set_length(all as u64);
        bar.set_position(drawn as u64);
    });
    bar.finish_and_clear();
    let written = written.map_err(failure)?;
    Ok(Report::text(format!(
        "wrote {}: {} images to train on, {} held out, {} points",
        args.path.display(),
        written.train,
        written.test,
        written.points
    )))
}

fn style() -> ProgressStyle {
    ProgressStyle::with_template("{msg} {bar:28} {pos}/{len}")
        .unwrap_or_else(|_| ProgressStyle::default_bar())
}

fn failure(error: SampleError) -> CliError {
    let kind = match &error {
        SampleError::NotEmpty(_) | SampleError::Exists(_) => ProblemType::Exists,
        SampleError::Side(_) => ProblemType::ImpossibleSize,
        SampleError::Io { .. } => ProblemType::UnwritableOutput,
        SampleError::Png(_) | SampleError::Zip(_) => ProblemType::Internal,
    };
    Problem::new(kind, error.to_string()).into()
}
