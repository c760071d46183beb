//! Codec, training, rendering, evaluation and service as commands use them: errors are [`Problem`]s that name the file in question.

mod first_key;
mod keys;
mod private;
mod rendering;
mod runtime;
mod service;
mod upkeep;
mod viewer;

use std::{
    path::{Path, PathBuf},
    sync::Arc,
    time::Instant,
};

use tcgs::{
    codec::{self, EncodeError, EncodeSettings, Encoded},
    domain::{
        AnchorScene, Background, ColorFitScores, Dataset, DatasetSummary, Image, MemoryLimits, NamedCamera,
        Problem, ProblemType, ReadOptions, Scene, Scores, Split,
    },
    eval::{
        InFlight, PerceptualDistance, Target, ViewTasks, for_each_view, mean_color_fit, mean_scores_with,
    },
    export::anchors,
    gpu::AdapterChoice,
    ingest::{self, LoadBudget},
    pipeline::{Pipeline, scene_file},
    render::{RenderViews, SceneViewer},
    train::{CheckpointError, CheckpointFolder},
};
use tcgs_lab::lpips::Lpips;

pub(crate) use keys::{
    WithoutKeys, change_key, change_project, create_key, create_project, keys, projects, revoke_key,
    without_keys,
};
pub(crate) use service::{ServeOptions, WorkerOptions, migrate, serve, worker};
pub(crate) use upkeep::{back_up, fsck, restore};
pub(crate) use viewer::{Advertised, ViewerOptions, viewer};

use super::{CliError, files, memory::MemoryFlags};

/// Default quantization step of features (the published one).
pub(crate) const FEATURE_STEP: f32 = 1.0;
/// Default quantization step of scalings as a fraction of the voxel.
pub(crate) const SCALING_STEP: f32 = 0.05;
/// Default quantization step of offsets (the published one).
pub(crate) const OFFSET_STEP: f32 = 0.2;

pub(crate) use tcgs::pipeline::{
    exported::{
        Baking, ExportSettings, Limited, Packing, Place, PlainScene, Quality, REFINEMENT_STEPS, Refiner,
        compare, export, plain, sphere, write as write_plain,
    },
    scene_file::{SceneFile, read},
    scene_views::SceneViews,
};

/// What is known of a file without decoding its attributes.
#[derive(Debug)]
pub(crate) struct Inspection {
    /// The report as JSON.
    pub(crate) json: serde_json::Value,
    /// The same as a table.
    pub(crate) text: String,
}

/// Reads a dataset; photographs may use half of the available memory.
pub(crate) fn load_as(path: &Path, reading: &ReadOptions) -> Result<Dataset, Problem> {
    let host = MemoryFlags::default().limits(1).host;
    let load_budget = LoadBudget { memory_bytes: host / 2, ..LoadBudget::default() };
    ingest::load_as(path, reading, &load_budget, &|| true).map_err(|error| named(error.into(), path))
}

/// Names the dataset in a problem that names no file in it.
pub(crate) fn named(problem: Problem, path: &Path) -> Problem {
    match problem.file {
        None => problem.in_file(path.display().to_string()),
        Some(_) => problem,
    }
}

/// Writes a folder as the zip that a service takes.
pub(crate) fn pack(folder: &Path, archive: &mut std::fs::File) -> Result<(), Problem> {
    ingest::pack(folder, archive).map_err(|error| named(error.into(), folder))
}

/// Checks a dataset without reading its pixels.
pub(crate) fn check_dataset(path: &Path, read: &ReadOptions) -> Result<(), Problem> {
    ingest::check_as(path, read).map(drop).map_err(|problem| named(problem, path))
}

/// What a dataset holds and its cameras. Pixels are read only where they decide how files are read.
pub(crate) fn survey_dataset(
    path: &Path,
    reading: &ReadOptions,
) -> Result<(DatasetSummary, Vec<NamedCamera>), Problem> {
    ingest::check_as(path, reading).map_err(|problem| named(problem, path))
}

/// The cameras of a dataset, without reading its pixels.
pub(crate) fn cameras(path: &Path, reading: &ReadOptions) -> Result<Vec<NamedCamera>, Problem> {
    Ok(survey_dataset(path, reading)?.1)
}

/// The mean error of held-out views in the high wavelet bands; `None` without such views.
pub(crate) fn high_band_error(
    renderer: &SceneViews,
    dataset: &Dataset,
    background: Background,
) -> Result<Option<f64>, Problem> {
    let mut errors = Vec::new();
    let tasks = ViewTasks::<_, Problem> {
        render: &mut |frame| renderer.view(&frame.camera),
        process: &|frame, render| {
            Ok(Target::of(frame, background)?.band_errors(&render).map(|error| error.high))
        },
        collect: &mut |error| {
            errors.extend(error);
            Ok(())
        },
    };
    // Bands have some 200 bytes per pixel.
    for_each_view(&dataset.split(Split::Test).collect::<Vec<_>>(), InFlight::One, tasks)?;
    Ok((!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64))
}

/// Encodes a scene.
pub(crate) fn encode(scene: &AnchorScene, settings: &EncodeSettings) -> Result<Encoded, Problem> {
    codec::encode(scene, None, settings).map_err(|error| match error {
        EncodeError::Verification | EncodeError::ReadBack(_) => {
            Problem::new(ProblemType::Internal, error.to_string())
        }
        _ => Problem::new(ProblemType::NotEncodable, error.to_string()),
    })
}

/// The bytes of a safetensors file with the anchors of `file`.
pub(crate) fn tensors(file: &SceneFile) -> Result<Vec<u8>, Problem> {
    match &file.scene {
        Scene::Anchors(scene) => scene_file::write_anchors(scene, file.background, file.dataset),
        Scene::Gaussians(_) => Err(scene_file::undecodable(
            "a file of plain Gaussians has no anchors to decode; its values are floats already",
        )),
    }
}

/// The anchors in a safetensors file.
pub(crate) fn anchors(bytes: &[u8]) -> Result<anchors::AnchorFile, Problem> {
    anchors::read(bytes).map_err(|error| Problem::new(ProblemType::NotAScene, error.to_string()))
}

/// Accounts for every byte of a `.tcgs` file.
pub(crate) fn inspect(bytes: &[u8]) -> Result<Inspection, Problem> {
    let inspection = codec::inspect(bytes).map_err(|error| scene_file::undecodable(error.to_string()))?;
    Ok(Inspection { json: json(&inspection)?, text: inspection.to_string() })
}

fn json(value: &impl serde::Serialize) -> Result<serde_json::Value, Problem> {
    serde_json::to_value(value).map_err(|error| Problem::new(ProblemType::Internal, error.to_string()))
}

/// The training pipeline within `memory`, with LPIPS if there are weights; `spill` is the folder of temporary files.
pub(crate) fn runner(
    adapter: &AdapterChoice,
    memory: MemoryLimits,
    spill: PathBuf,
    lpips: Option<Lpips>,
) -> Pipeline {
    Pipeline::new(adapter.clone())
        .within(memory, spill)
        .with_lpips(lpips.map(|lpips| Box::new(lpips) as Box<dyn PerceptualDistance>))
}

/// The weights of LPIPS in a file, if one is named.
pub(crate) fn lpips(path: Option<&Path>) -> Result<Option<Lpips>, CliError> {
    let Some(path) = path else { return Ok(None) };
    let bytes = files::read(path)?;
    let lpips = Lpips::from_safetensors(&bytes)
        .map_err(|error| Problem::from(error).in_file(path.display().to_string()))?;
    Ok(Some(lpips))
}

/// Checks that `folder` has a valid checkpoint; whether it belongs to the same run is checked on resuming.
pub(crate) fn check_checkpoint(folder: &Path) -> Result<(), Problem> {
    CheckpointFolder::load(folder).map(drop).map_err(|error| match error {
        error @ (CheckpointError::Missing(_) | CheckpointError::Io { .. }) => error.into(),
        error => Problem::from(error).in_file(folder.display().to_string()),
    })
}

/// The renderer of views within `memory` bytes on the device, and its adapter and driver in one line.
pub(crate) fn views(adapter: &AdapterChoice, memory: u64) -> Result<(Arc<dyn RenderViews>, String), Problem> {
    let viewer = SceneViewer::within(adapter.clone(), memory)?;
    let line = viewer.adapter_line();
    Ok((Arc::new(viewer), line))
}

/// The mean seconds of rendering a held-out view while nothing else runs; `None` without such views.
pub(crate) fn render_seconds(renderer: &SceneViews, dataset: &Dataset) -> Result<Option<f64>, Problem> {
    let (mut views, mut seconds) = (0, 0.0);
    for frame in dataset.split(Split::Test) {
        let started = Instant::now();
        renderer.view(&frame.camera)?;
        seconds += started.elapsed().as_secs_f64();
        views += 1;
    }
    Ok((views > 0).then(|| seconds / f64::from(views)))
}

/// What [`score`] measures.
pub(crate) struct Measured {
    /// The scores of the held-out views and their means.
    pub(crate) scores: Scores,
    /// Held-out views with and without a color correction.
    pub(crate) color_fit: Option<ColorFitScores>,
    /// Seconds of rendering.
    pub(crate) render_seconds: f64,
}

/// The scores of the held-out views and their means, and the seconds of rendering. `each` gets every view's name, render and
/// photograph, in the order of the frames. Views are scored while the next ones are rendered.
pub(crate) fn score(
    renderer: &SceneViews,
    dataset: &Dataset,
    background: Background,
    lpips: Option<&Lpips>,
    each: &mut dyn FnMut(&str, &Image, &Image) -> Result<(), CliError>,
) -> Result<Measured, CliError> {
    let (mut scores, mut halves) = (Vec::new(), Vec::new());
    let mut seconds = 0.0;
    let tasks = ViewTasks::<_, CliError> {
        render: &mut |frame| {
            let started = Instant::now();
            let render = renderer.view(&frame.camera)?;
            seconds += started.elapsed().as_secs_f64();
            Ok(render)
        },
        process: &|frame, render| {
            let name = &frame.name;
            let target = Target::of(frame, background).map_err(Problem::from)?;
            let different = || {
                let detail = format!("the render of {name} is not of its photograph's size");
                Problem::new(ProblemType::Internal, detail)
            };
            let mut score = target.score(name, &render).ok_or_else(different)?;
            let half = target.right_half(&render);
            if let Some(lpips) = lpips {
                let distance = lpips.distance(&target.masked(&render), target.photograph());
                score.lpips = Some(distance.map_err(|error| Problem::from(error).in_file(name))?);
            }
            Ok((score, half, render, target))
        },
        collect: &mut |(score, half, render, target)| {
            each(&score.name, &render, target.photograph())?;
            scores.push(score);
            halves.extend(half);
            Ok(())
        },
    };
    let in_flight = if lpips.is_some() { InFlight::One } else { InFlight::Several };
    for_each_view(&dataset.split(Split::Test).collect::<Vec<_>>(), in_flight, tasks)?;
    Ok(Measured {
        scores: mean_scores_with(&scores, lpips.map(Lpips::network)),
        color_fit: mean_color_fit(&halves),
        render_seconds: seconds,
    })
}
