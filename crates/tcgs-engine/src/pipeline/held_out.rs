//! Pictures of a finished file: of held-out views for the report, the worst first, each with photograph, render and error; and a thumbnail.
//!
//! They are rendered from the finished file's scene after everything is measured, and change nothing about it.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use thiserror::Error;

use super::{error::JobError, inputs::RunInputs, scene_file};
use crate::{
    domain::{Background, Frame, HeldOut, HeldOutView, Image, PhotographError, Problem, Scores, ViewScore},
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
/// Longest side of the thumbnail: twice what lists show, for screens with finer pixels.
const THUMBNAIL_SIDE: u32 = 480;
const THUMBNAIL_QUALITY: u8 = 80;

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

/// What is shown of a finished file.
#[derive(Debug, Default)]
pub(super) struct FilePictures {
    pub(super) held_out: Option<HeldOut>,
    /// JPEG.
    pub(super) thumbnail: Option<Vec<u8>>,
}

/// Pictures of a finished file, or none where they cannot be made: that must not fail the job, since only pages show them. Calls
/// `heartbeat` before each view.
pub(super) fn pictures_or_warn(
    inputs: &RunInputs<'_>,
    file: &[u8],
    scores: &Scores,
    heartbeat: &mut dyn FnMut(),
) -> Result<FilePictures, JobError> {
    let pictures = pictures(inputs, file, scores, heartbeat).unwrap_or_else(|error| {
        if !matches!(error, HeldOutError::Cancelled) {
            tracing::warn!("the job will have neither pictures of held-out views nor a thumbnail: {error}");
        }
        FilePictures::default()
    });
    inputs.check_cancelled()?;
    Ok(pictures)
}

fn pictures(
    inputs: &RunInputs<'_>,
    file: &[u8],
    scores: &Scores,
    heartbeat: &mut dyn FnMut(),
) -> Result<FilePictures, HeldOutError> {
    let file = scene_file::read(file).map_err(HeldOutError::File)?;
    let mut renderer = Renderer::of_scene(&inputs.device, &file.scene, file.background)?;
    let mut render = |frame: &Frame| {
        heartbeat();
        if inputs.cancel.is_cancelled() {
            return Err(HeldOutError::Cancelled);
        }
        Ok(renderer.render(&frame.camera)?)
    };
    let held_out = held_out(inputs, file.background, scores, &mut render)?;
    Ok(FilePictures { held_out, thumbnail: thumbnail(inputs, scores, &mut render)? })
}

/// Renders one view.
type RenderFrame<'a> = dyn FnMut(&Frame) -> Result<Image, HeldOutError> + 'a;

fn held_out(
    inputs: &RunInputs<'_>,
    background: Background,
    scores: &Scores,
    render: &mut RenderFrame<'_>,
) -> Result<Option<HeldOut>, HeldOutError> {
    let frames = inputs.test_views();
    let shown: Vec<(&ViewScore, &Frame)> = chosen(&scores.per_view)
        .into_iter()
        .filter_map(|score| Some((score, *frames.iter().find(|frame| frame.name == score.name)?)))
        .collect();
    let mut pictures = Vec::new();
    let tasks = ViewTasks::<_, HeldOutError> {
        render: &mut |frame| render(frame),
        process: &|frame, render| ViewPictures::of(frame, &render, &Target::of(frame, background)?),
        collect: &mut |made| {
            pictures.push(made);
            Ok(())
        },
    };
    let to_render: Vec<&Frame> = shown.iter().map(|(_, frame)| *frame).collect();
    for_each_view(&to_render, InFlight::Several, tasks)?;
    let views = shown.into_iter().zip(pictures);
    let views: Vec<HeldOutView> =
        views.map(|((score, frame), pictures)| pictures.beside(score, frame)).collect();
    let sheet = HeldOut { of: frames.len(), ceiling: ERROR_CEILING, ramp: error_ramp(), views };
    Ok((!sheet.views.is_empty()).then_some(sheet))
}

/// A small picture of the best held-out view or, without one, of the first training view.
fn thumbnail(
    inputs: &RunInputs<'_>,
    scores: &Scores,
    render: &mut RenderFrame<'_>,
) -> Result<Option<Vec<u8>>, HeldOutError> {
    let best = scores.per_view.iter().max_by(|a, b| a.psnr.total_cmp(&b.psnr));
    let frames = &inputs.dataset.frames;
    let frame = best.and_then(|best| frames.iter().find(|frame| frame.name == best.name)).or(frames.first());
    let Some(frame) = frame else { return Ok(None) };
    let small = shrunk(&render(frame)?, THUMBNAIL_SIDE);
    let small = small.ok_or_else(|| HeldOutError::Size(frame.name.clone()))?;
    Ok(Some(PictureFormat::Jpeg { quality: THUMBNAIL_QUALITY }.encode(&small)?))
}

/// The JPEG file of a picture in a preview.
///
/// # Errors
/// [`PictureError`] for a picture that JPEG has no place for.
pub fn preview_file(picture: &Image) -> Result<Vec<u8>, PictureError> {
    PictureFormat::Jpeg { quality: THUMBNAIL_QUALITY }.encode(picture)
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
