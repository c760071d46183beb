//! `tcgs export --format html`: a scene with its viewer as one page that opens from a disk.

use std::path::Path;

use base64::{Engine as _, engine::general_purpose::STANDARD};
use serde::Serialize;
use tcgs::{
    domain::{Background, Camera, Dataset, Frame, Orbit, Problem, ProblemType, SceneFormat, Split},
    eval::{Target, shrunk},
    picture::PictureFormat,
    viewer_page::{Assets, Stop, ViewerScene, assets, complete},
};

use super::{CliError, Report, files, wiring};

/// Longest side of a photograph in the page.
const SIDE: u32 = 512;
/// Photographs in the page.
const PHOTOGRAPHS: usize = 8;
const JPEG_QUALITY: u8 = 88;

#[derive(Debug, Serialize)]
struct Summary<'a> {
    output: &'a Path,
    format: &'static str,
    bytes: usize,
    /// Of the scene's file in the page.
    scene_bytes: usize,
    cameras: usize,
    photographs: usize,
}

/// Writes the page of a `.tcgs` file. With a dataset, its cameras are stops, held-out ones first, some of them with their photographs.
pub(super) fn run(file: &Path, output: &Path, dataset: Option<&Dataset>) -> Result<Report, CliError> {
    files::check_output(output, file, &["html"])?;
    let bytes = files::read(file)?;
    let scene = wiring::read(&bytes).map_err(|problem| problem.in_file(file.display().to_string()))?;
    if scene.format != SceneFormat::Tcgs {
        let problem = Problem::new(ProblemType::NotExportable, "a page shows .tcgs files only");
        return Err(problem.in_file(file.display().to_string()).into());
    }
    let assets = built()?;
    let cameras: Vec<Camera> = match dataset {
        Some(dataset) => dataset.frames.iter().map(|frame| frame.camera).collect(),
        None => wiring::sphere(&scene, PHOTOGRAPHS)?,
    };
    let stops = match dataset {
        Some(dataset) => stops(dataset, scene.background)?,
        None => cameras
            .iter()
            .zip(1..)
            .map(|(camera, index)| Stop::new(format!("view {index}"), camera, None))
            .collect(),
    };
    let orbit = Orbit::around(&cameras).ok_or_else(|| {
        Problem::new(ProblemType::NotExportable, "the dataset has no cameras to begin with")
    })?;
    let title =
        file.file_stem().map_or_else(|| "scene".to_owned(), |stem| stem.to_string_lossy().into_owned());
    let photographs = stops.iter().filter(|stop| stop.has_photograph()).count();
    let summary = Summary {
        output,
        format: "html",
        bytes: 0,
        scene_bytes: bytes.len(),
        cameras: stops.len(),
        photographs,
    };
    let scene = ViewerScene { title, stops, center: orbit.center, up: orbit.up, links: None };
    let page = complete(&scene, assets, &bytes);
    files::write(output, page.as_bytes())?;
    let summary = Summary { bytes: page.len(), ..summary };
    let text = format!(
        "wrote     {}: {} bytes, of which the scene is {}; {} cameras, {} photographs; opens in a browser with WebGPU",
        output.display(),
        summary.bytes,
        summary.scene_bytes,
        summary.cameras,
        summary.photographs
    );
    Ok(Report::new(text, &summary))
}

fn built() -> Result<Assets, CliError> {
    let missing =
        "this tcgs was built without the viewer for browsers; run scripts/web.sh, then build it again";
    assets().ok_or_else(|| Problem::new(ProblemType::NotExportable, missing).into())
}

/// The dataset's cameras, those held out first and the first of them with photographs.
fn stops(dataset: &Dataset, background: Background) -> Result<Vec<Stop>, Problem> {
    let of = |split: Split| dataset.split(split);
    let held_out = of(Split::Test).enumerate().map(|(index, frame)| {
        let photograph = (index < PHOTOGRAPHS).then(|| photograph(frame, background)).transpose()?;
        Ok(Stop::new(frame.name.clone(), &frame.camera, photograph))
    });
    let others = of(Split::Train).map(|frame| Ok(Stop::new(frame.name.clone(), &frame.camera, None)));
    held_out.chain(others).collect()
}

/// A photograph as a small JPEG in base64.
fn photograph(frame: &Frame, background: Background) -> Result<String, Problem> {
    let target = Target::of(frame, background)?;
    let failed = |error: &dyn std::fmt::Display| {
        Problem::new(
            ProblemType::Internal,
            format!("the photograph {} cannot be written: {error}", frame.name),
        )
    };
    let small = shrunk(target.photograph(), SIDE).ok_or_else(|| failed(&"it is empty"))?;
    let jpeg =
        PictureFormat::Jpeg { quality: JPEG_QUALITY }.encode(&small).map_err(|error| failed(&error))?;
    Ok(STANDARD.encode(jpeg))
}
