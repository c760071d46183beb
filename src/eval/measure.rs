//! Renders frames of a dataset and compares them with their photographs.

use super::{Lpips, score_view};
use crate::{
    domain::{Background, Frame, ViewScore},
    render::{RenderError, SceneRenderer},
};

/// PSNR and SSIM of each frame, photographs composited on `background`.
///
/// # Errors
/// Errors of the renderer; a photograph that cannot be read back.
pub fn measure_views(
    renderer: &mut SceneRenderer,
    frames: &[&Frame],
    background: Background,
) -> Result<Vec<ViewScore>, RenderError> {
    measure_views_with(renderer, frames, background, None)
}

/// The score of each frame, with LPIPS where there are weights for it. A frame that LPIPS cannot compare has none; the
/// log says why.
///
/// # Errors
/// Errors of the renderer.
pub fn measure_views_with(
    renderer: &mut SceneRenderer,
    frames: &[&Frame],
    background: Background,
    lpips: Option<&Lpips>,
) -> Result<Vec<ViewScore>, RenderError> {
    frames
        .iter()
        .map(|frame| {
            let render = renderer.render(&frame.camera)?;
            let photograph = frame.image.load()?.over(background.rgb8());
            let mut score = score_view(&frame.name, &render, &photograph).ok_or_else(|| {
                RenderError::Scene(format!("frame {} is not of its camera's size", frame.name))
            })?;
            score.lpips = lpips.and_then(|lpips| {
                let distance = lpips.distance(&render, &photograph);
                distance.inspect_err(|fault| tracing::warn!("{}: no LPIPS: {fault}", frame.name)).ok()
            });
            Ok(score)
        })
        .collect()
}
