//! `tcgs train`: trains a scene from a dataset, writes its file and reports its metrics.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use tcgs::{
    domain::{CurvePoint, ExposureChoice, JobMetrics, Phase, SceneFormat, TrainOptions},
    ingest,
    pipeline::{CheckpointPlan, JobError, Resume, RunJob as _},
    worker::CameraSearch,
};
use tempfile::TempDir;

use super::{
    CliError, Report, adapter::AdapterFlag, camera_search::usual_camera_search, files, lpips::LpipsFlag,
    memory::MemoryFlags, notice::notice, options::TrainFlags, poses, profile, progress::Display,
    signals::Interruption, wiring,
};

/// Arguments of `tcgs train`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder or zip: Blender, nerfstudio or COLMAP layout; or a folder of photographs, whose cameras are found first
    dataset: PathBuf,

    /// The file to write: .tcgs; for the models scaffold .safetensors, 3dgs .ply. With --rd-curve it is the file of the first
    /// lambda; the others, and the first again, have lambda in their names, as in OUT.lambda-0.001.tcgs
    #[arg(short, long, value_name = "OUT.tcgs")]
    output: PathBuf,

    #[command(flatten)]
    options: TrainFlags,

    #[command(flatten)]
    adapter: AdapterFlag,

    #[command(flatten)]
    memory: MemoryFlags,

    #[command(flatten)]
    lpips: LpipsFlag,

    /// Write a checkpoint to this folder every minute and when the run is interrupted
    #[arg(long, value_name = "DIR")]
    checkpoint: Option<PathBuf>,

    /// Resume from the checkpoint in this folder, which must be of the same dataset and options; new ones are written there
    /// too, unless --checkpoint names another folder
    #[arg(long, value_name = "DIR")]
    resume: Option<PathBuf>,

    /// Also print where a step's time goes, on the host and on the device; slows the run, whose result stays the same
    #[arg(long)]
    profile: bool,

    /// Print the metrics as one JSON document
    #[arg(long)]
    pub(super) json: bool,
}

/// Trains, writes the file, reports its metrics.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let options = args.options.validated()?;
    files::check_output(&args.output, &args.dataset, &[SceneFormat::of_model(options.model).extension()])?;
    for lambda in &options.rd_curve {
        files::check_writable(&with_lambda(&args.output, *lambda))?;
    }
    let checkpoints = checkpoints(args)?;
    let lpips = wiring::lpips(args.lpips.lpips.as_deref())?;
    let memory = args.memory.limits(1);
    let runner = wiring::runner(&args.adapter.adapter, memory, ingest::large_file_dir(), lpips)
        .with_profile(args.profile);
    let interruption = Interruption::listen();
    let posed = with_cameras(args, &options, &interruption)?;
    let dataset = posed.as_ref().map_or(&args.dataset, |(_, dataset)| dataset);

    let mut display = Display::new();
    let mut reached = Phase::Ingest;
    let outcome = runner.run(
        dataset,
        &options,
        &checkpoints,
        &mut |phase, progress| {
            reached = phase;
            display.show(phase, progress);
        },
        &interruption.cancel,
    );
    display.finish();
    let output = outcome.map_err(|failure| match failure {
        // An upload has no name, but a dataset on the command line has one.
        JobError::Fail(problem)
            if reached == Phase::Ingest && problem.file.is_none() && problem.status < 500 =>
        {
            CliError::Problem(problem.in_file(args.dataset.display().to_string()))
        }
        JobError::Fail(problem) | JobError::Retry(problem) | JobError::Hold(problem) => {
            CliError::Problem(problem)
        }
        JobError::Cancelled => interruption.error(advice(&checkpoints)),
    })?;
    files::write(&args.output, &output.file)?;
    let mut written = vec![args.output.clone()];
    for (lambda, file) in output.files() {
        let Some(lambda) = lambda else { continue };
        let path = with_lambda(&args.output, lambda);
        files::write(&path, file)?;
        written.push(path);
    }
    let mut report = report(&output.metrics, &written);
    if args.profile {
        let table = profile::table(&runner.profile());
        report.text.push_str(&format!("\n\n{}", profile::text(&table)));
        if let Value::Object(members) = &mut report.json {
            members.insert("profile".to_owned(), json!(table));
        }
    }
    Ok(report)
}

/// A dataset of the photographs, in a temporary folder that is kept with it, where the folder has no cameras.
fn with_cameras(
    args: &Args,
    options: &TrainOptions,
    interruption: &Interruption,
) -> Result<Option<(TempDir, PathBuf)>, CliError> {
    let lacks_cameras = ingest::lacks_cameras(&args.dataset, &options.reading());
    if !lacks_cameras.map_err(|problem| wiring::named(problem, &args.dataset))? {
        return Ok(None);
    }
    if args.checkpoint.is_some() || args.resume.is_some() {
        let error = "a run with checkpoints needs a dataset that stays; make it with `tcgs poses` first";
        return Err(CliError::Usage(error.to_owned()));
    }
    notice("the photographs have no cameras, which are found first; `tcgs poses` keeps them");
    let work = poses::work_folder(&ingest::large_file_dir())?;
    let search = camera_search(args.memory, options);
    let (found, dataset) = poses::dataset(&search, &args.dataset, work.path(), interruption)?;
    notice(poses::text(&found).trim_end());
    Ok(Some((work, dataset)))
}

/// The search for cameras, within the memory that is stated for the run.
fn camera_search(memory: MemoryFlags, options: &TrainOptions) -> CameraSearch {
    usual_camera_search(memory.stated_host()).of_job(options)
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

/// The name of a curve's file: that of the output with lambda before its extension.
fn with_lambda(output: &Path, lambda: f64) -> PathBuf {
    let stem = output.file_stem().unwrap_or_default().to_string_lossy();
    let extension = output.extension().map(|extension| format!(".{}", extension.to_string_lossy()));
    output.with_file_name(format!("{stem}.lambda-{lambda}{}", extension.unwrap_or_default()))
}

/// A curve in the format of the 3DGS.zip survey, a line for each point.
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

/// How a run that was stopped goes on.
fn advice(checkpoints: &CheckpointPlan) -> String {
    match &checkpoints.keep {
        Some(folder) => format!("go on with --resume {}", folder.display()),
        None => "nothing is kept without --checkpoint DIR".to_owned(),
    }
}

/// The checkpoint flags; their folders are checked before anything that takes long.
fn checkpoints(args: &Args) -> Result<CheckpointPlan, CliError> {
    let keep = args.checkpoint.clone().or_else(|| args.resume.clone());
    if let Some(folder) = &args.resume {
        wiring::check_checkpoint(folder)?;
    }
    if let Some(folder) = &keep {
        files::check_writable(&folder.join("checkpoint"))?;
    }
    Ok(CheckpointPlan { keep, resume: args.resume.clone().map_or(Resume::Fresh, Resume::From) })
}

/// How figures were measured, for people; JSON and reports have every convention.
pub(super) const MEASURED: &str = "on 8-bit RGB of the decoded file; --json has every convention";

/// The figures of a finished job, for people.
pub(super) fn text(metrics: &JobMetrics) -> String {
    let figure = |value: Option<f64>, digits: usize, unit: &str| {
        value.map_or_else(|| "none".to_owned(), |value| format!("{value:.digits$}{unit}"))
    };
    let lossless = figure(metrics.psnr_before_quantisation, 2, " dB");
    let halves = metrics.color_fit.map_or_else(String::new, |fit| format!("halves    {fit}\n"));
    let exposure = match metrics.exposure {
        Some(choice) if choice != ExposureChoice::OFF => {
            let state = if choice.corrected { "on" } else { "off" };
            format!("exposure  color corrections {state}: {}\n", choice.because())
        }
        _ => String::new(),
    };
    let crop = metrics.crop.map_or_else(String::new, |crop| format!("crop      {crop}\n"));
    format!(
        "test      PSNR {} (before quantization {lossless})  SSIM {}{}  over {} views on {}\n\
         {halves}{exposure}{crop}\
         train     PSNR {}  SSIM {}  over {} views\n\
         size      {} bytes; {} anchors, {} Gaussians\n\
         time      {:.1} s training, {} steps, {:.2} steps/s; {:.2} s encoding, {:.2} s decoding\n\
         adapter   {}\n\
         decoded   {}\n\
         measured  {MEASURED}",
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
    )
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        memory: MemoryFlags,
    }

    #[test]
    fn the_memory_of_a_run_bounds_its_search_for_cameras() {
        let line = Line::try_parse_from(["train", "--host-memory", "4GiB"]).expect("parses");
        let search = camera_search(line.memory, &TrainOptions::default());
        assert_eq!(search.estimator.limits.memory_bytes, 4 << 30);
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
