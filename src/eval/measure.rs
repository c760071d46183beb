//! Renders frames of a dataset and compares them with their photographs.

use super::ViewScore;
use crate::{
    domain::{Background, Frame},
    render::{RenderError, SceneRenderer},
};

/// The score of each frame, photographs composited on `background`.
///
/// # Errors
/// Faults of the renderer; a photograph that cannot be read back.
pub fn measure_views(
    renderer: &mut SceneRenderer,
    frames: &[&Frame],
    background: Background,
) -> Result<Vec<ViewScore>, RenderError> {
    frames
        .iter()
        .map(|frame| {
            let render = renderer.render(&frame.camera)?;
            let photograph = frame.image.load()?.over(background.rgb8());
            ViewScore::measure(&frame.name, &render, &photograph).ok_or_else(|| {
                RenderError::Scene(format!("frame {} is not of its camera's size", frame.name))
            })
        })
        .collect()
}
