//! `tcgs train`: a dataset in, one file and its metrics out.

use std::{
    path::{Path, PathBuf},
    thread,
};

use clap::builder::{PossibleValuesParser, TypedValueParser};
use serde_json::{Value, json};
use tcgs::{
    domain::{
        Background, CancelFlag, Component, CurvePoint, JobMetrics, ModelKind, OptionError, Phase, Preset,
        TrainOptions, Voxel,
    },
    pipeline::{Checkpoints, JobError, Resume},
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
pub(super) struct Options {
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

    /// Parts that a run of so few steps would do without: plane-compression is in runs of 30000 steps and more
    #[arg(long, value_name = "PARTS", value_parser = choice!(Component), value_delimiter = ',')]
    with: Vec<Component>,

    /// Weight of the file's size in the loss: larger makes smaller files
    #[arg(long, value_name = "X")]
    lambda: Option<f64>,

    /// Bytes that the file may have, all of it: steps become coarser and Gaussians are left out until it fits
    #[arg(long, value_name = "N")]
    max_bytes: Option<u64>,

    /// Train once up to where the weight of the rate matters, then go on with each of these weights, and write a file for
    /// each: OUT is that of the first, and beside it each has its weight in its name, as in OUT.lambda-0.001.tcgs
    #[arg(long, value_name = "LIST", value_delimiter = ',', allow_negative_numbers = true)]
    rd_curve: Vec<f64>,
}

/// Reads what `--voxel` takes.
pub(super) fn voxel(text: &str) -> Result<Voxel, String> {
    text.parse().map_err(|fault: OptionError| fault.fault)
}

impl Options {
    pub(super) fn train_options(&self) -> Result<TrainOptions, Failure> {
        let options = TrainOptions {
            preset: self.preset,
            iterations: self.iterations,
            seed: self.seed,
            background: self.background,
            model: self.model,
            voxel: self.voxel,
            without: self.without.iter().copied().collect(),
            with: self.with.iter().copied().collect(),
            lambda: self.lambda,
            max_bytes: self.max_bytes,
            rd_curve: self.rd_curve.clone(),
        };
        Ok(options.validated()?)
    }
}

/// Trains, writes the file, reports its metrics.
pub(crate) fn run(args: &Args) -> Result<Report, Failure> {
    let options = args.options.train_options()?;
    files::check_writable(&args.output)?;
    for lambda in &options.rd_curve {
        files::check_writable(&with_lambda(&args.output, *lambda))?;
    }
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
        JobError::Fail(problem) if reached == Phase::Ingest && problem.file.is_none() => {
            Failure::Problem(problem.in_file(args.dataset.display().to_string()))
        }
        JobError::Fail(problem) | JobError::Retry(problem) | JobError::Hold(problem) => {
            Failure::Problem(problem)
        }
        JobError::Cancelled => Failure::Stopped,
    })?;
    files::write(&args.output, &output.file)?;
    let mut written = vec![args.output.clone()];
    for (lambda, file) in output.files() {
        let Some(lambda) = lambda else { continue };
        let path = with_lambda(&args.output, lambda);
        files::write(&path, file)?;
        written.push(path);
    }
    Ok(report(&output.metrics, &written))
}

fn report(metrics: &JobMetrics, written: &[PathBuf]) -> Report {
    let mut text = text(metrics);
    let mut report = Report::new(String::new(), metrics);
    if !metrics.rd_curve.is_empty() {
        text.push_str(&format!("\n\n{}", survey(&metrics.rd_curve)));
        let files = metrics.rd_curve.iter().zip(&written[1..]);
        let files = files.map(|(point, path)| json!({ "lambda": point.lambda, "path": path })).collect();
        if let Value::Object(members) = &mut report.json {
            members.insert("files".to_owned(), Value::Array(files));
        }
    }
    for path in written {
        text.push_str(&format!("\nwrote {}", path.display()));
    }
    report.text = text;
    report
}

/// The name of a curve's file: that of the output with the weight before its extension.
fn with_lambda(output: &Path, lambda: f64) -> PathBuf {
    let stem = output.file_stem().unwrap_or_default().to_string_lossy();
    let extension = output.extension().map(|extension| format!(".{}", extension.to_string_lossy()));
    output.with_file_name(format!("{stem}.lambda-{lambda}{}", extension.unwrap_or_default()))
}

/// A curve as the field's survey of compression methods takes it: a line a point.
fn survey(curve: &[CurvePoint]) -> String {
    let mut lines = vec!["Submethod,PSNR,SSIM,LPIPS,Size [Bytes],#Gaussians".to_owned()];
    lines.extend(curve.iter().map(|point| {
        let figure = |value: Option<f64>, digits: usize| {
            value.map_or_else(String::new, |value| format!("{value:.digits$}"))
        };
        let CurvePoint { lambda, bytes, gaussians, .. } = point;
        let [psnr, ssim, lpips] = [figure(point.psnr, 2), figure(point.ssim, 4), figure(point.lpips, 4)];
        format!("lambda-{lambda},{psnr},{ssim},{lpips},{bytes},{gaussians}")
    }));
    lines.join("\n")
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

/// The figures of a finished job, for people.
pub(super) fn text(metrics: &JobMetrics) -> String {
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
        for flags in [["--iterations", "0"], ["--lambda", "0"], ["--max-bytes", "0"]] {
            let failure = parse(&flags).train_options().expect_err("impossible");
            assert_eq!(failure.exit_status(), 2);
            assert!(failure.to_string().starts_with(flags[0]), "{failure}");
        }
        assert!(Line::try_parse_from(["train", "--preset", "fast"]).is_err());
        let options = parse(&["--rd-curve", "0.004,0.0005"]).train_options().expect("possible");
        assert_eq!(options.rd_curve, [0.004, 0.0005]);
        for wrong in ["0", "-1", "nan", "0.001,0.001"] {
            let failure = parse(&["--rd-curve", wrong]).train_options().expect_err("impossible");
            assert!(failure.exit_status() == 2 && failure.to_string().starts_with("--rd-curve"), "{failure}");
        }
        let both = parse(&["--rd-curve", "0.001", "--max-bytes", "9"]).train_options();
        assert_eq!(both.expect_err("impossible").exit_status(), 2);
    }

    #[test]
    fn files_of_a_curve_are_named_by_their_weights() {
        for (output, expected) in [
            ("out/chair.tcgs", "out/chair.lambda-0.0005.tcgs"),
            ("chair", "chair.lambda-0.0005"),
            ("a.b.tcgs", "a.b.lambda-0.0005.tcgs"),
        ] {
            assert_eq!(with_lambda(Path::new(output), 5e-4), Path::new(expected));
        }
    }

    #[test]
    fn a_curve_is_told_in_the_surveys_format() {
        let point = |lambda, bytes, lpips| CurvePoint {
            lambda,
            bytes,
            psnr: Some(30.126),
            ssim: Some(0.95),
            lpips,
            gaussians: 77,
            sha256: tcgs::domain::Digest::of(b"a file"),
        };
        let text = survey(&[point(0.004, 1200, None), point(1e-3, 3400, Some(0.123_44))]);
        assert_eq!(
            text,
            "Submethod,PSNR,SSIM,LPIPS,Size [Bytes],#Gaussians\n\
             lambda-0.004,30.13,0.9500,,1200,77\n\
             lambda-0.001,30.13,0.9500,0.1234,3400,77"
        );
    }
}
