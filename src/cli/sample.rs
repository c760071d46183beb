//! `tcgs sample`: the bundled scene as a dataset.

use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};
use tcgs::{
    domain::{Problem, ProblemType},
    poses::find_ffmpeg,
    sample::{self, SampleCounts, SampleError, Settings},
};

use super::{CliError, Report};

/// Arguments of `tcgs sample`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A new folder, or a new file whose name ends in .zip; in .mp4 for a video of a walk around the scene, which ffmpeg writes
    #[arg(value_name = "PATH")]
    path: PathBuf,

    /// Width and height of each image in pixels
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u32).range(8..=4096))]
    side: u32,

    /// Width and height of each image in pixels, such as 4000x3000, in place of --side
    #[arg(long, value_name = "WxH", conflicts_with = "side", value_parser = size)]
    size: Option<(u32, u32)>,

    /// Images; of a video, frames of which 25 are a second
    #[arg(long, value_name = "N", default_value_t = Settings::default().views)]
    views: usize,

    /// Points in the cloud
    #[arg(long, value_name = "N", default_value_t = Settings::default().points, value_parser = points)]
    points: usize,

    /// Photographs as JPEG files alone, without cameras and points
    #[arg(long)]
    photographs: bool,

    /// Seed of the point cloud
    #[arg(long, value_name = "N", default_value_t = Settings::default().seed)]
    seed: u64,
}

fn size(text: &str) -> Result<(u32, u32), String> {
    let sides = text.split_once('x').and_then(|(width, height)| width.parse().ok().zip(height.parse().ok()));
    sides.ok_or_else(|| "two numbers such as 4000x3000 are needed".to_owned())
}

/// Most points of a cloud.
const MAX_POINTS: usize = 10_000_000;

fn points(text: &str) -> Result<usize, String> {
    let count = text.parse().ok().filter(|count| (1..=MAX_POINTS).contains(count));
    count.ok_or_else(|| format!("is not 1 to {MAX_POINTS}"))
}

/// Renders and writes the scene.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let (width, height) = args.size.unwrap_or((args.side, args.side));
    let Args { views, points, seed, photographs: is_bare, .. } = *args;
    let settings = Settings { width, height, views, points, seed, is_bare };
    // Hidden where standard error is no terminal.
    let bar = ProgressBar::new(0).with_message("images").with_style(style());
    let watch = &mut |drawn, all| {
        bar.set_length(all as u64);
        bar.set_position(drawn as u64);
    };
    let path = &args.path;
    let written = if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mp4")) {
        let frames = sample::write_video(path, &settings, &find_ffmpeg(), watch);
        frames.map(|frames| format!("{frames} frames"))
    } else {
        sample::write_watched(path, &settings, watch).map(|written| counts(&written))
    };
    bar.finish_and_clear();
    let written = written.map_err(failure)?;
    Ok(Report::text(format!("wrote {}: {written}", path.display())))
}

fn counts(SampleCounts { train, test, points }: &SampleCounts) -> String {
    match test {
        0 => format!("{train} photographs"),
        _ => format!("{train} images to train on, {test} held out, {points} points"),
    }
}

fn style() -> ProgressStyle {
    ProgressStyle::with_template("{msg} {bar:28} {pos}/{len}")
        .unwrap_or_else(|_| ProgressStyle::default_bar())
}

fn failure(error: SampleError) -> CliError {
    let kind = match &error {
        SampleError::NotEmpty(_) | SampleError::Exists(_) => ProblemType::Exists,
        SampleError::Size(..) | SampleError::OddSize(..) | SampleError::Views(_) => {
            ProblemType::ImpossibleSize
        }
        SampleError::Io { .. } => ProblemType::UnwritableOutput,
        SampleError::NoFfmpeg { .. } | SampleError::Ffmpeg(_) => ProblemType::Unavailable,
        SampleError::Png(_) | SampleError::Jpeg(_) | SampleError::Zip(_) => ProblemType::Internal,
    };
    Problem::new(kind, error.to_string()).into()
}
