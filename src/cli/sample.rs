//! `tcgs sample`: the bundled scene as a dataset.

use std::path::PathBuf;

use tcgs::{
    domain::Problem,
    sample::{self, SampleError, Settings},
};

use super::{Failure, Report};

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
pub(crate) fn run(args: &Args) -> Result<Report, Failure> {
    let settings = Settings { side: args.side, seed: args.seed, ..Settings::default() };
    let written = sample::write(&args.path, &settings).map_err(failure)?;
    Ok(Report::text(format!(
        "wrote {}: {} images to train on, {} held out, {} points",
        args.path.display(),
        written.train,
        written.test,
        written.points
    )))
}

fn failure(fault: SampleError) -> Failure {
    let (status, name, title) = match &fault {
        SampleError::NotEmpty(_) | SampleError::Exists(_) => (409, "exists", "Something is there already"),
        SampleError::Side(_) => (422, "impossible-size", "Impossible size"),
        SampleError::Io { .. } => (507, "unwritable-output", "The output cannot be written"),
        SampleError::Png(_) | SampleError::Zip(_) => (500, "internal", "Internal error"),
    };
    Problem::new(status, name, title, fault.to_string()).into()
}
