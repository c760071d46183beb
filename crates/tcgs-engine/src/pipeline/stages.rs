//! What each stage between training and the decoded file costs: rounding, noise in its place, quantized networks, and rendering in f32.
//!
//! Every figure is of the same few held-out views, so that stages differ by nothing else.

use std::collections::HashMap;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::{
    encode::EncodedFile,
    error::JobError,
    inputs::{ReferenceViews, RunInputs},
};
use crate::{
    codec::{DecodeLimits, StoredSteps, stored_steps},
    domain::{
        AnchorScene, Background, CodingStages, Frame, RenderingError, Scene, SceneFormat,
        anchors::SCALINGS_PER_ANCHOR, evenly_spaced::evenly_spaced,
    },
    eval::{ColorError, ViewMeasurement, reference_view},
    render::{Renderer, twin::Cutoffs},
    train::Trained,
};

/// Held-out views of the stages of coding, at most.
const STAGE_VIEWS: usize = 8;

/// The PSNR at each stage; `None` for files of floats and without held-out views.
pub(super) fn coding_stages(
    inputs: &RunInputs<'_>,
    background: Background,
    trained: &Trained,
    written: &EncodedFile,
    heartbeat: &mut dyn FnMut(),
) -> Result<Option<CodingStages>, JobError> {
    let test_views = inputs.test_views();
    let frames: Vec<&Frame> = evenly_spaced(&test_views, STAGE_VIEWS).copied().collect();
    let (Scene::Anchors(decoded), Scene::Anchors(scene)) = (&written.file.scene, &trained.scene) else {
        return Ok(None);
    };
    if written.file.format != SceneFormat::Tcgs || frames.is_empty() {
        return Ok(None);
    }
    let floats = match &trained.unrounded {
        Some(Scene::Anchors(floats)) => floats,
        _ => scene,
    };
    let steps = stored_steps(&written.bytes, &DecodeLimits::NONE)
        .map_err(|error| JobError::internal(error.to_string()))?;
    let rounded = AnchorScene { networks: scene.networks.clone(), ..decoded.clone() };
    let noisy = with_noise(&rounded, floats, &steps);
    let mut psnr = |scene: &AnchorScene| -> Result<f64, JobError> {
        let mut renderer = Renderer::new(&inputs.device, scene, background)?;
        let before_each = &mut || {
            inputs.check_cancelled()?;
            heartbeat();
            Ok::<_, JobError>(())
        };
        let measurement = ViewMeasurement { renderer: &mut renderer, background, before_each };
        Ok(measurement.mean_psnr(&frames)?.unwrap_or_default())
    };
    Ok(Some(CodingStages {
        views: frames.len(),
        floats: psnr(floats)?,
        noise: psnr(&noisy)?,
        rounded: psnr(&rounded)?,
        decoded: psnr(decoded)?,
    }))
}

/// The scene `rounded` with the values that its anchors have in `floats` and noise of each anchor's steps. Anchors without a counterpart
/// keep their values.
fn with_noise(rounded: &AnchorScene, floats: &AnchorScene, steps: &StoredSteps) -> AnchorScene {
    let places: HashMap<[i32; 3], usize> =
        floats.cells.iter().enumerate().map(|(place, cell)| (*cell, place)).collect();
    let mut noisy = rounded.clone();
    // The same for every scene, so that two measurements of one file agree.
    let mut rng = Pcg64::seed_from_u64(0);
    for anchor in 0..noisy.cells.len() {
        let Some(place) = places.get(&noisy.cells[anchor]).copied() else { continue };
        let mut replace = |values: &mut [f32], from: &[f32], width: usize, step: f32| {
            let target = &mut values[anchor * width..][..width];
            for (value, exact) in target.iter_mut().zip(&from[place * width..][..width]) {
                *value = exact + step * (rng.random::<f32>() - 0.5);
            }
        };
        let [feature, scaling, offset] = [0, 1, 2].map(|group| steps.steps[group][anchor]);
        replace(&mut noisy.features, &floats.features, floats.feature_dim, feature);
        replace(&mut noisy.scalings, &floats.scalings, SCALINGS_PER_ANCHOR, scaling);
        replace(&mut noisy.offsets, &floats.offsets, 3 * floats.offsets_per_anchor, offset);
        // The finest scaling of a file is one step; noise must not make one negative.
        for value in &mut noisy.scalings[anchor * SCALINGS_PER_ANCHOR..][..SCALINGS_PER_ANCHOR] {
            *value = value.max(0.5 * scaling);
        }
    }
    noisy
}

/// The renderer against the reference on the decoded scene; `None` if that is not asked for or there are no held-out views.
pub(super) fn rendering_error(
    inputs: &RunInputs<'_>,
    background: Background,
    scene: &Scene,
    heartbeat: &mut dyn FnMut(),
) -> Result<Option<RenderingError>, JobError> {
    let Some(ReferenceViews { views, max_side }) = inputs.reference else { return Ok(None) };
    let test_views = inputs.test_views();
    let frames: Vec<&Frame> = evenly_spaced(&test_views, views).copied().collect();
    let Some(first) = frames.first() else { return Ok(None) };
    let mut renderer = Renderer::of_scene(&inputs.device, scene, background)?;
    let (mut squares, mut max, mut cutoff_squares) = (0.0, 0.0_f64, 0.0);
    for frame in &frames {
        inputs.check_cancelled()?;
        heartbeat();
        let camera = frame.camera.within(max_side);
        let exact = reference_view(scene, &camera, background, Cutoffs::default())?;
        heartbeat();
        let whole = reference_view(scene, &camera, background, Cutoffs::FINE)?;
        let as_f32 = |pixels: &[[f64; 3]]| -> Vec<[f32; 4]> {
            pixels.iter().map(|[r, g, b]| [*r as f32, *g as f32, *b as f32, 0.0]).collect()
        };
        let different = || JobError::internal("a view and its reference differ in size");
        let error = ColorError::of(&renderer.colors(&camera)?, &exact).ok_or_else(different)?;
        let cut = ColorError::of(&as_f32(&exact), &whole).ok_or_else(different)?;
        squares += error.rmse.powi(2);
        cutoff_squares += cut.rmse.powi(2);
        max = max.max(error.max);
    }
    let count = frames.len() as f64;
    let intrinsics = first.camera.within(max_side).intrinsics;
    Ok(Some(RenderingError {
        views: frames.len(),
        size: [intrinsics.width, intrinsics.height],
        rmse: (squares / count).sqrt(),
        max,
        cutoff_rmse: (cutoff_squares / count).sqrt(),
    }))
}
