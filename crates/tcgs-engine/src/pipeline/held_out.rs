//! Pictures of held-out views for the report: photograph, render and error, the worst views first.
//!
//! They are rendered from the finished file's scene after everything is measured, and change nothing about it.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use thiserror::Error;

use super::{error::JobError, inputs::RunInputs, scene_file};
use crate::{
    domain::{Frame, HeldOut, HeldOutView, Image, PhotographError, Problem, Scores, ViewScore},
    eval::{ERROR_CEILING, InFlight, Target, ViewTasks, error_map, error_ramp, for_each_view, shrunk},
    picture::{PictureError, PictureFormat},
    render::{RenderError, Renderer},
};

/// Views in the report.
const SHOWN: usize = 12;
/// How many of them are the best, for comparison, if there are more.
const BEST: usize = 2;
/// Longest side of a picture.
const SIDE: u32 = 512;
const JPEG_QUALITY: u8 = 88;

/// Why there are no pictures.
#[derive(Debug, Error)]
enum HeldOutError {
    #[error("{}", .0.detail)]
    File(Problem),
    #[error("cancelled")]
    Cancelled,
    #[error(transparent)]
    Render(#[from] RenderError),
    #[error(transparent)]
    Photograph(#[from] PhotographError),
    #[error("render and photograph of {0} differ in size")]
    Size(String),
    #[error("a picture cannot be encoded: {0}")]
    Picture(#[from] PictureError),
}

/// Pictures of held-out views of a finished file, or none where they cannot be made: that must not fail the job, since only its
/// report shows them. Calls `heartbeat` before each view.
pub(super) fn held_out_or_warn(
    inputs: &RunInputs<'_>,
    file: &[u8],
    scores: &Scores,
    heartbeat: &mut dyn FnMut(),
) -> Result<Option<HeldOut>, JobError> {
    let pictures = held_out(inputs, file, scores, heartbeat).unwrap_or_else(|error| {
        tracing::warn!("the report will have no held-out views: {error}");
        None
    });
    inputs.check_cancelled()?;
    Ok(pictures)
}

fn held_out(
    inputs: &RunInputs<'_>,
    file: &[u8],
    scores: &Scores,
    heartbeat: &mut dyn FnMut(),
) -> Result<Option<HeldOut>, HeldOutError> {
    let file = scene_file::read(file).map_err(HeldOutError::File)?;
    let mut renderer = Renderer::of_scene(&inputs.device, &file.scene, file.background)?;
    let frames = inputs.test_views();
    let shown: Vec<(&ViewScore, &Frame)> = chosen(&scores.per_view)
        .into_iter()
        .filter_map(|score| Some((score, *frames.iter().find(|frame| frame.name == score.name)?)))
        .collect();
    let mut pictures = Vec::new();
    let tasks = ViewTasks::<_, HeldOutError> {
        render: &mut |frame| {
            heartbeat();
            if inputs.cancel.is_cancelled() {
                return Err(HeldOutError::Cancelled);
            }
            Ok(renderer.render(&frame.camera)?)
        },
        process: &|frame, render| ViewPictures::of(frame, &render, &Target::of(frame, file.background)?),
        collect: &mut |made| {
            pictures.push(made);
            Ok(())
        },
    };
    let to_render: Vec<&Frame> = shown.iter().map(|(_, frame)| *frame).collect();
    match for_each_view(&to_render, InFlight::Several, tasks) {
        Err(HeldOutError::Cancelled) => return Ok(None),
        result => result?,
    }
    let views = shown.into_iter().zip(pictures);
    let views: Vec<HeldOutView> =
        views.map(|((score, frame), pictures)| pictures.beside(score, frame)).collect();
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

/// The small pictures of a view, in base64.
struct ViewPictures {
    width: u32,
    height: u32,
    photograph: String,
    render: String,
    error: String,
}

impl ViewPictures {
    /// The error is none where no pixel counts.
    fn of(frame: &Frame, render: &Image, target: &Target) -> Result<Self, HeldOutError> {
        let size = || HeldOutError::Size(frame.name.clone());
        let photograph = target.photograph();
        let error = error_map(&target.masked(render), photograph, SIDE).ok_or_else(size)?;
        let small = |image| shrunk(image, SIDE).ok_or_else(size);
        Ok(Self {
            width: error.width(),
            height: error.height(),
            photograph: jpeg(&small(photograph)?)?,
            render: jpeg(&small(render)?)?,
            error: jpeg(&error)?,
        })
    }

    fn beside(self, score: &ViewScore, frame: &Frame) -> HeldOutView {
        let Self { width, height, photograph, render, error } = self;
        HeldOutView { score: score.clone(), camera: frame.camera, width, height, photograph, render, error }
    }
}

fn jpeg(image: &Image) -> Result<String, PictureError> {
    Ok(STANDARD.encode(PictureFormat::Jpeg { quality: JPEG_QUALITY }.encode(image)?))
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
