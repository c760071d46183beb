//! Pictures of held-out views for the report: photograph, render and error, the worst views first.
//!
//! They are made of the finished file's scene once everything is measured, and change nothing about it.

use std::io::Cursor;

use base64::{Engine as _, engine::general_purpose::STANDARD};
use image::{ExtendedColorType, ImageEncoder as _, codecs::jpeg::JpegEncoder};
use thiserror::Error;

use crate::{
    domain::{Background, Frame, HeldOut, HeldOutView, Image, PhotographError, Scores, ViewScore},
    eval::{ERROR_CEILING, error_map, error_ramp, shrunk},
    render::{RenderError, SceneRenderer},
};

/// Views that are shown.
const SHOWN: usize = 12;
/// Of them, where there are more: the best, for comparison.
const BEST: usize = 2;
/// Longest side of a picture.
const SIDE: u32 = 512;
const JPEG_QUALITY: u8 = 88;

/// Why there are no pictures.
#[derive(Debug, Error)]
pub(super) enum SheetError {
    /// A view cannot be rendered.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// A photograph cannot be had.
    #[error(transparent)]
    Photograph(#[from] PhotographError),
    /// Render and photograph are of different shapes.
    #[error("the render of {0} is not of its photograph's shape")]
    Shape(String),
    /// A picture cannot be written.
    #[error("a picture cannot be written: {0}")]
    Jpeg(#[from] image::ImageError),
}

/// Renders the views that are to be shown; `go_on` is asked before each, and there is no result once it says no.
pub(super) fn held_out(
    renderer: &mut SceneRenderer,
    frames: &[&Frame],
    scores: &Scores,
    background: Background,
    go_on: &mut dyn FnMut() -> bool,
) -> Result<Option<HeldOut>, SheetError> {
    let mut views = Vec::new();
    for score in chosen(&scores.per_view) {
        let Some(frame) = frames.iter().find(|frame| frame.name == score.name) else { continue };
        if !go_on() {
            return Ok(None);
        }
        let render = renderer.render(&frame.camera)?;
        let photograph = frame.image.load()?.over(background.rgb8());
        views.push(view(score, frame, &render, &photograph)?);
    }
    let sheet = HeldOut { of: frames.len(), ceiling: ERROR_CEILING, ramp: error_ramp(), views };
    Ok((!sheet.views.is_empty()).then_some(sheet))
}

/// The views to show, worst first.
fn chosen(scores: &[ViewScore]) -> Vec<&ViewScore> {
    let mut sorted: Vec<&ViewScore> = scores.iter().collect();
    sorted.sort_by(|a, b| a.psnr.total_cmp(&b.psnr));
    if sorted.len() > SHOWN {
        sorted.drain(SHOWN - BEST..sorted.len() - BEST);
    }
    sorted
}

fn view(
    score: &ViewScore,
    frame: &Frame,
    render: &Image,
    photograph: &Image,
) -> Result<HeldOutView, SheetError> {
    let shape = || SheetError::Shape(frame.name.clone());
    let error = error_map(render, photograph, SIDE).ok_or_else(shape)?;
    let small = |image| shrunk(image, SIDE).ok_or_else(shape);
    Ok(HeldOutView {
        score: score.clone(),
        camera: frame.camera,
        width: error.width(),
        height: error.height(),
        photograph: jpeg(&small(photograph)?)?,
        render: jpeg(&small(render)?)?,
        error: jpeg(&error)?,
    })
}

fn jpeg(image: &Image) -> Result<String, image::ImageError> {
    let mut file = Cursor::new(Vec::new());
    JpegEncoder::new_with_quality(&mut file, JPEG_QUALITY).write_image(
        image.samples(),
        image.width(),
        image.height(),
        ExtendedColorType::Rgb8,
    )?;
    Ok(STANDARD.encode(file.into_inner()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_views_come_first_and_the_best_two_stand_at_the_end() {
        let scores = |count: usize| -> Vec<ViewScore> {
            let psnr = |index: usize| 20.0 + (index * 7 % count) as f64;
            let view =
                |index| ViewScore { name: format!("{index}"), psnr: psnr(index), ssim: 0.5, lpips: None };
            (0..count).map(view).collect()
        };
        let shown = |count| chosen(&scores(count)).iter().map(|view| view.psnr - 20.0).collect::<Vec<_>>();
        assert_eq!(shown(3), [0.0, 1.0, 2.0]);
        let many = shown(20);
        assert_eq!(many.len(), SHOWN);
        assert_eq!(many[..10], (0..10).map(f64::from).collect::<Vec<_>>());
        assert_eq!(many[10..], [18.0, 19.0]);
        assert!(chosen(&[]).is_empty());
    }

    #[test]
    fn pictures_are_jpeg_files_in_base64() {
        let image = Image::new(2, 1, 3, vec![255, 0, 0, 0, 0, 255]).expect("an image");
        let file = STANDARD.decode(jpeg(&image).expect("encodes")).expect("base64");
        assert!(file.starts_with(b"\xff\xd8"));
    }
}
