//! Crops: what is removed, and that every figure is of the file that is delivered.

use std::{path::Path, sync::LazyLock};

use glam::DVec3;
use tcgs::{
    domain::{
        CancelFlag, Crop, CropRegion, ModelKind, Phase, Problem, ProblemType, Progress, Scene, SceneFrame,
        TrainOptions,
    },
    ingest,
    pipeline::{CheckpointPlan, JobError, JobOutput, Pipeline, Resume, RunJob, scene_file},
    sample::{self, Settings},
};
use tempfile::TempDir;

use crate::support::gpu::choice;

static DATASET: LazyLock<TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().expect("a folder");
    sample::write(&folder.path().join("set"), &Settings { points: 300, ..Settings::square(32) })
        .expect("writes");
    folder
});

fn set() -> std::path::PathBuf {
    DATASET.path().join("set")
}

/// Around the still life, without the ground far from it and the sky.
const BOX: Crop = Crop::Box([-1.0, -1.0, -0.2], [1.2, 1.3, 1.2]);

fn options(model: ModelKind, crop: Crop) -> TrainOptions {
    TrainOptions { model, crop, iterations: Some(12), ..TrainOptions::default() }
}

fn run_with(
    options: &TrainOptions,
    checkpoints: &CheckpointPlan,
    report: &mut dyn FnMut(Phase, &Progress),
    cancel: &CancelFlag,
) -> Result<JobOutput, JobError> {
    Pipeline::new(choice()).run(&set(), options, checkpoints, report, cancel)
}

fn run(options: &TrainOptions) -> JobOutput {
    run_with(options, &CheckpointPlan::default(), &mut |_, _| (), &CancelFlag::default()).expect("a file")
}

/// Centers of a file's Gaussians in the world.
fn centers(file: &[u8]) -> Vec<DVec3> {
    let world = |frame: SceneFrame, center: [f32; 3]| frame.to_world(DVec3::from(center.map(f64::from)));
    match scene_file::read(file).expect("a scene").scene {
        Scene::Gaussians(scene) => scene.means.iter().map(|mean| world(scene.frame, *mean)).collect(),
        Scene::Anchors(scene) => (0..scene.masks.len())
            .filter(|offset| scene.masks[*offset])
            .map(|offset| world(scene.frame, scene.gaussian_center(offset)))
            .collect(),
    }
}

#[test]
fn a_box_leaves_its_gaussians_and_the_figures_are_those_of_the_file() {
    for model in [ModelKind::Tcgs, ModelKind::Scaffold, ModelKind::Gaussians3d] {
        let whole = run(&options(model, Crop::None));
        let cropped = run(&options(model, BOX));
        assert_eq!(whole.metrics.crop, None);
        let cost = cropped.metrics.crop.expect("a cost");
        assert_eq!(cost.region, BOX);
        assert_eq!(cropped.metrics.bytes.total, cropped.file.len() as u64);
        let saved = whole.file.len() as i64 - cropped.file.len() as i64;
        assert_eq!((cost.saved_bytes, saved > 0), (saved, true), "{model}");
        let lost = whole.metrics.test.psnr.zip(cropped.metrics.test.psnr).map(|(a, b)| a - b);
        assert_eq!(cost.lost_psnr, lost, "{model}");
        assert!(lost.expect("held-out views") > 0.0, "{model}: {lost:?}");
        let left = centers(&cropped.file);
        assert_eq!(cropped.metrics.gaussians, left.len() as u64);
        assert_eq!(cost.gaussians_removed, whole.metrics.gaussians - left.len() as u64);
        // Rounding moves a center by a fraction of a voxel.
        let Crop::Box(least, greatest) = BOX else { unreachable!("a box") };
        let region = CropRegion::Box {
            least: DVec3::from(least) - DVec3::splat(0.02),
            greatest: DVec3::from(greatest) + DVec3::splat(0.02),
        };
        for center in left {
            assert!(region.contains(center), "{model}: {center}");
        }
        let file = scene_file::read(&cropped.file).expect("a scene");
        assert_eq!(file.decode_sha256, cropped.metrics.decode_sha256, "{model}");
    }
}

#[test]
fn a_target_size_is_that_of_the_cropped_file() {
    let limit = run(&options(ModelKind::Tcgs, BOX)).file.len() as u64;
    let limited = TrainOptions { max_bytes: Some(limit), ..options(ModelKind::Tcgs, BOX) };
    let output = run(&limited);
    assert!(output.file.len() as u64 <= limit);
    let saved = output.metrics.crop.expect("a cost").saved_bytes;
    let whole = output.file.len() as i64 + saved;
    assert!(whole > limit as i64, "the whole scene takes {whole} bytes, within the {limit} of its crop");
}

#[test]
fn cameras_around_an_object_keep_it_and_a_region_that_has_everything_costs_nothing() {
    let options = |crop| TrainOptions { crop, ..options(ModelKind::Gaussians3d, Crop::None) };
    let cropped = run(&options(Crop::Cameras));
    let cost = cropped.metrics.crop.expect("a cost");
    assert!(cost.gaussians_removed > 0, "the sky, at least: {cost:?}");
    let dataset = ingest::load(&set()).expect("a dataset");
    let region = CropRegion::of_dataset(&Crop::Cameras, &dataset).expect("a region");
    let left = centers(&cropped.file);
    assert!(left.iter().all(|center| region.contains(*center)));
    assert!(left.iter().any(|center| center.distance(DVec3::new(0.12, 0.1, 0.32)) < 0.5), "the still life");

    let everything = run(&options(Crop::Box([-1e4; 3], [1e4; 3])));
    let cost = everything.metrics.crop.expect("a cost");
    assert_eq!((cost.gaussians_removed, cost.saved_bytes, cost.lost_psnr), (0, 0, Some(0.0)));
}

#[test]
fn a_box_without_a_point_is_refused_before_training() {
    let mut reached = Vec::new();
    let away = options(ModelKind::Tcgs, Crop::Box([50.0; 3], [60.0; 3]));
    let report = &mut |phase, _: &Progress| reached.push(phase);
    let refused = run_with(&away, &CheckpointPlan::default(), report, &CancelFlag::default());
    let Err(JobError::Fail(problem)) = refused else { panic!("not refused: {refused:?}") };
    assert!(problem.is(ProblemType::EmptyCrop), "{problem}");
    for part in ["none of the", "points of the dataset lies in the box 50,50,50,60,60,60", "they lie between"]
    {
        assert!(problem.detail.contains(part), "{}", problem.detail);
    }
    assert!(reached.iter().all(|phase| *phase == Phase::Ingest), "{reached:?}");
}

/// A copy of the dataset without its points, so that only the trained scene tells that a box is empty.
fn without_points(folder: &Path) {
    std::fs::create_dir_all(folder.join("images")).expect("a folder");
    for entry in std::fs::read_dir(set().join("images")).expect("photographs") {
        let entry = entry.expect("a photograph");
        std::fs::copy(entry.path(), folder.join("images").join(entry.file_name())).expect("copies");
    }
    let table = std::fs::read(set().join("transforms.json")).expect("a table");
    let mut table: serde_json::Value = serde_json::from_slice(&table).expect("JSON");
    table.as_object_mut().expect("an object").remove("ply_file_path").expect("it names points");
    std::fs::write(folder.join("transforms.json"), table.to_string()).expect("writes");
}

#[test]
fn a_box_without_a_gaussian_fails_the_run_and_its_checkpoint_serves_another_box() {
    let folder = tempfile::tempdir().expect("a folder");
    let (bare, kept) = (folder.path().join("set"), folder.path().join("kept"));
    without_points(&bare);
    std::fs::create_dir(&kept).expect("a folder");
    let pipeline = Pipeline::new(choice());
    let run = |crop: Crop, resume: Resume| -> Result<JobOutput, JobError> {
        let checkpoints = CheckpointPlan { keep: Some(kept.clone()), resume };
        let options = options(ModelKind::Gaussians3d, crop);
        pipeline.run(&bare, &options, &checkpoints, &mut |_, _| (), &CancelFlag::default())
    };
    let refused: Problem = match run(Crop::Box([500.0; 3], [600.0; 3]), Resume::Fresh) {
        Err(JobError::Fail(problem)) => problem,
        other => panic!("not refused: {other:?}"),
    };
    assert!(refused.is(ProblemType::EmptyCrop) && refused.detail.contains("Gaussians lies"), "{refused}");

    let whole = run(Crop::None, Resume::Fresh).expect("a file");
    // A run that is stopped while it trains leaves a checkpoint, which runs with any crop resume.
    let cancel = CancelFlag::default();
    let stopping = &mut |phase, progress: &Progress| {
        if phase == Phase::Train && progress.step > 0 {
            cancel.cancel();
        }
    };
    let checkpoints = CheckpointPlan { keep: Some(kept.clone()), resume: Resume::Fresh };
    let stopped =
        pipeline.run(&bare, &options(ModelKind::Gaussians3d, Crop::None), &checkpoints, stopping, &cancel);
    assert!(matches!(stopped, Err(JobError::Cancelled)), "{stopped:?}");
    let resumed = run(Crop::Box([-2.0; 3], [2.0; 3]), Resume::From(kept.clone())).expect("a file");
    let cost = resumed.metrics.crop.expect("a cost");
    assert_eq!(cost.saved_bytes, whole.file.len() as i64 - resumed.file.len() as i64);
}
