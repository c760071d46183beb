//! The figures of a finished file: of its scene as read back, not of the scene that was trained.

use super::{
    encode::EncodedFile,
    error::JobError,
    inputs::RunInputs,
    scene_file::SceneFile,
    stages::{coding_stages, rendering_error},
};
use crate::{
    domain::{Background, ColorFitScores, Conventions, Frame, JobMetrics, PhaseSeconds, Scene, Scores},
    eval::{PerceptualDistance, ViewMeasurement, mean_color_fit, mean_scores_with},
    export::world::{Origin, in_world_units},
    render::Renderer,
    train::Trained,
};

/// Training views that the reported training figures are measured on, evenly spread.
const MEASURED_TRAIN_VIEWS: usize = 16;

/// Mean held-out PSNR of a file; `None` without held-out views.
pub(super) fn held_out_psnr(
    inputs: &RunInputs<'_>,
    background: Background,
    file: &SceneFile,
    heartbeat: &mut dyn FnMut(),
) -> Result<Option<f64>, JobError> {
    let before_each = &mut || {
        inputs.check_cancelled()?;
        heartbeat();
        Ok::<_, JobError>(())
    };
    let mut renderer = Renderer::of_scene(&inputs.device, &file.scene, background)?;
    let measurement = ViewMeasurement { renderer: &mut renderer, background, before_each };
    measurement.mean_psnr(&inputs.test_views())
}

/// Measures the file, and the held-out views of the scene before quantization if the file differs from it. Calls `heartbeat`
/// before each view.
pub(super) fn measure(
    inputs: &RunInputs<'_>,
    background: Background,
    trained: &Trained,
    written: &EncodedFile,
    heartbeat: &mut dyn FnMut(),
) -> Result<JobMetrics, JobError> {
    let file = &written.file;
    let mut before_each = || {
        inputs.check_cancelled()?;
        heartbeat();
        Ok::<_, JobError>(())
    };
    let mut renderer = Renderer::of_scene(&inputs.device, &file.scene, background)?;
    let mut score = |frames: &[&Frame]| -> Result<(Scores, Option<ColorFitScores>), JobError> {
        let (renderer, before_each) = (&mut renderer, &mut before_each);
        let measurement = ViewMeasurement { renderer, background, before_each };
        let (views, halves) = measurement.scores_with_halves(frames, inputs.lpips)?;
        let scores = mean_scores_with(&views, inputs.lpips.map(PerceptualDistance::network));
        Ok((scores, mean_color_fit(&halves)))
    };
    let held_out = inputs.test_views();
    let (test, color_fit) = score(&held_out)?;
    let (train, _) = score(&inputs.train_views(MEASURED_TRAIN_VIEWS))?;
    drop(renderer);
    // Compression-aware training leaves a scene that is rounded already.
    let unrounded = match trained.unrounded.as_ref().unwrap_or(&trained.scene) {
        Scene::Gaussians(scene) => &Scene::Gaussians(in_world_units(scene, Origin::Nearby)),
        anchors => anchors,
    };
    let before = if *unrounded == file.scene {
        test.psnr
    } else {
        let mut renderer = Renderer::of_scene(&inputs.device, unrounded, background)?;
        let (renderer, before_each) = (&mut renderer, &mut before_each);
        ViewMeasurement { renderer, background, before_each }.mean_psnr(&held_out)?
    };
    Ok(JobMetrics {
        test,
        train,
        bytes: file.byte_counts.clone(),
        seconds: PhaseSeconds {
            ingest: inputs.ingest_seconds,
            train: trained.seconds,
            encode: written.encode_seconds,
            decode: written.decode_seconds,
        },
        steps: u64::from(trained.steps),
        steps_per_second: f64::from(trained.steps) / trained.seconds.max(1e-9),
        view_pixels: inputs.view_pixels(),
        anchors: file.scene.anchors() as u64,
        gaussians: file.scene.gaussians() as u64,
        psnr_before_quantisation: before,
        decode_sha256: file.decode_sha256,
        adapter: inputs.device.adapter_line(),
        background,
        conventions: Conventions::new(inputs.lpips.map(PerceptualDistance::network)),
        byte_budget: written.budget,
        convergence: None,
        coding: written.coding,
        stages: coding_stages(inputs, background, trained, written, heartbeat)?,
        rendering: rendering_error(inputs, background, &file.scene, heartbeat)?,
        frame: Some(trained.scene.frame()),
        color_fit,
        exposure: Some(trained.exposure),
        crop: None,
        rd_curve: Vec::new(),
    })
}
