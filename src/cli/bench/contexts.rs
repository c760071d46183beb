//! `tcgs bench contexts`: what planes and neighbors save in finished scenes of several sizes, in bytes of whole files.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use serde::Serialize;
use tcgs::{
    domain::{CancelFlag, Problem, ProblemType},
    gpu::Device,
    train::ContextFitSettings,
};

use tcgs_lab::context_trials::{ContextTrial, TrialScene, context_trials};

use crate::cli::{CliError, Report, adapter::AdapterFlag, files};

/// Arguments of `tcgs bench contexts`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The .tcgs files of scenes; of several, each gives an equal share of the anchors, side by side
    #[arg(required = true)]
    files: Vec<PathBuf>,

    /// Anchors of the parts that are measured; 0 for all
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [0])]
    anchors: Vec<usize>,

    /// Steps of each fit
    #[arg(long, value_name = "N", default_value_t = 3000, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    steps: u32,

    /// Seed of the models
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,

    /// Print one JSON document
    #[arg(long)]
    pub(super) json: bool,

    #[command(flatten)]
    adapter: AdapterFlag,
}

#[derive(Debug, Serialize)]
struct Contexts {
    /// Adapter, driver and backend.
    adapter: String,
    parts: Vec<Part>,
}

/// One part of the scenes.
#[derive(Debug, Serialize)]
struct Part {
    anchors: usize,
    gaussians: usize,
    trials: Vec<ContextTrial>,
}

/// Measures every part.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let scenes = args.files.iter().map(|file| read(file)).collect::<Result<Vec<_>, _>>()?;
    let device = Device::new(&args.adapter.adapter).map_err(Problem::from)?;
    let mut contexts = Contexts { adapter: device.adapter_line(), parts: Vec::new() };
    for anchors in &args.anchors {
        contexts.parts.push(measure(&device, &scenes, *anchors, args)?);
    }
    Ok(Report::new(text(&contexts), &contexts))
}

fn read(file: &Path) -> Result<TrialScene, CliError> {
    Ok(TrialScene::read(&files::read(file)?)
        .map_err(|problem| problem.in_file(file.display().to_string()))?)
}

fn measure(
    device: &Arc<Device>,
    scenes: &[TrialScene],
    anchors: usize,
    args: &Args,
) -> Result<Part, Problem> {
    let share = if anchors == 0 { usize::MAX } else { anchors.div_ceil(scenes.len()) };
    let mut parts = scenes.iter().map(|scene| scene.crop(share));
    let mut part = parts
        .next()
        .ok_or_else(|| Problem::new(ProblemType::Undecodable, "there is no scene to measure".to_owned()))?;
    for other in parts {
        part.put_beside(&other)?;
    }
    let settings = ContextFitSettings { steps: args.steps, seed: args.seed };
    let count = part.scene.len();
    let mut begin = |context: &str| tracing::info!(anchors = count, context, "measuring");
    let trials = context_trials(device, &part, settings, &mut begin, &CancelFlag::default())?;
    Ok(Part { anchors: count, gaussians: part.scene.gaussians(), trials })
}

fn text(contexts: &Contexts) -> String {
    let mut lines = vec![contexts.adapter.clone()];
    for Part { anchors, gaussians, trials } in &contexts.parts {
        lines.push(String::new());
        lines.push(format!("{anchors} anchors, {gaussians} Gaussians; bytes"));
        lines.push(format!(
            "{:>9} {:>9} {:>9} {:>9} {:>9} {:>9} {:>7}  context",
            "features", "scalings", "offsets", "networks", "planes", "file", "fit s"
        ));
        for ContextTrial { context, bytes, fit_seconds } in trials {
            lines.push(format!(
                "{:>9} {:>9} {:>9} {:>9} {:>9} {:>9} {fit_seconds:>7.1}  {context}",
                bytes.features, bytes.scalings, bytes.offsets, bytes.networks, bytes.planes, bytes.total
            ));
        }
    }
    lines.join("\n")
}
