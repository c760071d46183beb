//! `tcgs train`: a dataset in, one file and its metrics out.

use std::{path::PathBuf, thread};

use clap::builder::{PossibleValuesParser, TypedValueParser};
use tcgs::{
    domain::{
        Background, CancelFlag, Component, JobMetrics, ModelKind, OptionError, Phase, Preset, TrainOptions,
        Voxel,
    },
    worker::run::{Checkpoints, JobFailure, Resume},
};

use super::{
    Failure, Report, adapter::AdapterFlag, files, lpips::LpipsFlag, memory::MemoryFlags, progress::Display,
    wiring,
};

/// A value parser that knows and lists the names of a choice.
macro_rules! choice {
    ($name:ident) => {
        PossibleValuesParser::new($name::ALL.iter().map(|choice| choice.name()))
            .try_map(|text| text.parse::<$name>())
    };
}
pub(super) use choice;

/// Arguments of `tcgs train`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder or zip: Blender, nerfstudio or COLMAP layout
    dataset: PathBuf,

    /// The file to write: .tcgs; for the models scaffold .safetensors, 3dgs .ply
    #[arg(short, long, value_name = "OUT.tcgs")]
    output: PathBuf,

    #[command(flatten)]
    options: Options,

    #[command(flatten)]
    adapter: AdapterFlag,

    #[command(flatten)]
    memory: MemoryFlags,

    #[command(flatten)]
    lpips: LpipsFlag,

    /// Keep a checkpoint of the run in this folder, replaced every minute and when the run is interrupted
    #[arg(long, value_name = "DIR")]
    checkpoint: Option<PathBuf>,

    /// Go on from the checkpoint in this folder, which must be of the same dataset and options; new ones are kept
    /// there too, if not by --checkpoint elsewhere
    #[arg(long, value_name = "DIR")]
    resume: Option<PathBuf>,

    /// Print the metrics as one JSON document
    #[arg(long)]
    pub(super) json: bool,
}

/// Training options; the same names as in the query of `POST /v1/jobs`.
#[derive(Debug, clap::Args)]
struct Options {
    /// Schedule: preview for a software adapter, standard for a GPU, paper as published
    #[arg(long, value_name = "P", value_parser = choice!(Preset), default_value_t = Preset::Preview)]
    preset: Preset,

    /// Training steps, if not the preset's
    #[arg(long, value_name = "N")]
    iterations: Option<u32>,

    /// Seed of every random choice
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,

    /// What is behind images with alpha, and behind the renders
    #[arg(long, value_parser = choice!(Background), default_value_t = Background::Black)]
    background: Background,

    /// What is trained: tcgs, or one of the baselines that it is measured against
    #[arg(long, value_parser = choice!(ModelKind), default_value_t = ModelKind::Tcgs)]
    model: ModelKind,

    /// Edge of a cell of the anchors' lattice: auto (by the points' spacing), published (by the published rule), or world
    /// units
    #[arg(long, value_name = "V", value_parser = voxel, default_value_t = Voxel::Auto, allow_negative_numbers = true)]
    voxel: Voxel,

    /// Parts of the method to leave out
    #[arg(long, value_name = "PARTS", value_parser = choice!(Component), value_delimiter = ',')]
    without: Vec<Component>,

    /// Weight of the file's size in the loss: larger makes smaller files
    #[arg(long, value_name = "X")]
    lambda: Option<f64>,

    /// Largest file to write
    #[arg(long, value_name = "N", hide = true)]
    max_bytes: Option<u64>,
}

/// Reads what `--voxel` takes.
pub(super) fn voxel(text: &str) -> Result<Voxel, String> {
    text.parse().map_err(|fault: OptionError| fault.fault)
}

impl Options {
    fn train_options(&self) -> Result<TrainOptions, Failure> {
        let options = TrainOptions {
            preset: self.preset,
            iterations: self.iterations,
            seed: self.seed,
            background: self.background,
            model: self.model,
            voxel: self.voxel,
            without: self.without.iter().copied().collect(),
            lambda: self.lambda,
            max_bytes: self.max_bytes,
        };
        Ok(options.validated()?)
    }
}

/// Trains, writes the file, reports its metrics.
pub(crate) fn run(args: &Args) -> Result<Report, Failure> {
    let options = args.options.train_options()?;
    files::check_writable(&args.output)?;
    let checkpoints = checkpoints(args)?;
    let lpips = wiring::lpips(args.lpips.lpips.as_deref())?;
    let memory = args.memory.limits(1);
    let runner = wiring::runner(&args.adapter.adapter, memory, std::env::temp_dir(), lpips)?;
    let cancel = CancelFlag::default();
    cancel_on_interrupt(cancel.clone());

    let mut display = Display::new();
    let mut reached = Phase::Ingest;
    let outcome = runner.run(
        &args.dataset,
        &options,
        &checkpoints,
        &mut |phase, progress| {
            reached = phase;
            display.show(phase, progress);
        },
        &cancel,
    );
    display.finish();
    let output = outcome.map_err(|failure| match failure {
        // The service has no name for an upload; here it has one.
        JobFailure::Fail(problem) if reached == Phase::Ingest && problem.file.is_none() => {
            Failure::Problem(problem.in_file(args.dataset.display().to_string()))
        }
        JobFailure::Fail(problem) | JobFailure::Retry(problem) => Failure::Problem(problem),
        JobFailure::Cancelled => Failure::Stopped,
    })?;
    files::write(&args.output, &output.file)?;
    let text = format!("{}\nwrote {}", text(&output.metrics), args.output.display());
    Ok(Report::new(text, &output.metrics))
}

/// What the flags say of checkpoints, with what they name checked before anything else takes its time.
fn checkpoints(args: &Args) -> Result<Checkpoints, Failure> {
    let keep = args.checkpoint.clone().or_else(|| args.resume.clone());
    if let Some(folder) = &args.resume {
        wiring::check_checkpoint(folder)?;
    }
    if let Some(folder) = &keep {
        files::check_writable(&folder.join("checkpoint"))?;
    }
    Ok(Checkpoints { keep, resume: args.resume.clone().map_or(Resume::Fresh, Resume::From) })
}

/// The first interrupt asks the run to stop; the second, which finds the signal's old meaning gone, ends the process.
pub(super) fn cancel_on_interrupt(cancel: CancelFlag) {
    let watch = move || {
        let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_io().build() else { return };
        if runtime.block_on(tokio::signal::ctrl_c()).is_err() {
            return;
        }
        eprintln!("tcgs: stopping; interrupt again to end at once");
        cancel.cancel();
        if runtime.block_on(tokio::signal::ctrl_c()).is_ok() {
            std::process::exit(1);
        }
    };
    if let Err(fault) = thread::Builder::new().name("interrupt".to_owned()).spawn(watch) {
        tracing::warn!(%fault, "an interrupt will end the run at once");
    }
}

fn text(metrics: &JobMetrics) -> String {
    let figure = |value: Option<f64>, digits: usize, unit: &str| {
        value.map_or_else(|| "none".to_owned(), |value| format!("{value:.digits$}{unit}"))
    };
    let lossless = figure(metrics.psnr_before_quantisation, 2, " dB");
    format!(
        "test      PSNR {} (before quantisation {lossless})  SSIM {}{}  over {} views on {}\n\
         train     PSNR {}  SSIM {}  over {} views\n\
         size      {} bytes; {} anchors, {} Gaussians\n\
         time      {:.1} s training, {} steps, {:.2} steps/s; {:.2} s encoding, {:.2} s decoding\n\
         adapter   {}\n\
         decoded   {}\n\
         measured  {}",
        figure(metrics.test.psnr, 2, " dB"),
        figure(metrics.test.ssim, 4, ""),
        metrics.test.lpips_network.map_or_else(String::new, |network| {
            format!("  {network} {}", figure(metrics.test.lpips, 4, ""))
        }),
        metrics.test.views,
        metrics.background,
        figure(metrics.train.psnr, 2, " dB"),
        figure(metrics.train.ssim, 4, ""),
        metrics.train.views,
        metrics.bytes.total,
        metrics.anchors,
        metrics.gaussians,
        metrics.seconds.train,
        metrics.steps,
        metrics.steps_per_second,
        metrics.seconds.encode,
        metrics.seconds.decode,
        metrics.adapter,
        metrics.decode_sha256,
        metrics.conventions,
    )
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        options: Options,
    }

    fn parse(flags: &[&str]) -> Options {
        Line::try_parse_from([&["train"], flags].concat()).expect("parses").options
    }

    #[test]
    fn no_flag_means_the_default_options() {
        assert_eq!(parse(&[]).train_options(), Ok(TrainOptions::default()));
    }

    #[test]
    fn flags_become_options_and_impossible_ones_are_wrong_usage() {
        let flags = ["--preset", "standard", "--iterations", "900", "--seed", "7", "--background", "white"];
        let options = parse(&flags).train_options().expect("possible");
        assert_eq!(options.preset, Preset::Standard);
        assert_eq!((options.iterations, options.seed), (Some(900), 7));
        assert_eq!(options.background, Background::White);
        for flags in [["--iterations", "0"], ["--without", "knn,masks"], ["--max-bytes", "1000"]] {
            let failure = parse(&flags).train_options().expect_err("impossible");
            assert_eq!(failure.exit_status(), 2);
            assert!(failure.to_string().starts_with(flags[0]), "{failure}");
        }
        assert!(Line::try_parse_from(["train", "--preset", "fast"]).is_err());
    }
}
