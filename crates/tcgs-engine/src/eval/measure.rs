//! Renders frames of a dataset and compares them with their photographs.

use super::{
    ColorFit, PerceptualDistance, RightHalf, Target, TrainView,
    overlap::{InFlight, ViewTasks, for_each_view},
};
use crate::{
    domain::{Background, Frame, Image, ViewScore},
    render::{RenderError, Renderer},
};

/// Renders frames and compares them with their photographs over a background.
pub struct ViewMeasurement<'a, E> {
    /// Renders the views.
    pub renderer: &'a mut Renderer,
    /// The background of the photographs.
    pub background: Background,
    /// Called before each view is rendered; an error ends the measurement.
    pub before_each: &'a mut dyn FnMut() -> Result<(), E>,
}

impl<E: From<RenderError> + Send> ViewMeasurement<'_, E> {
    /// PSNR and SSIM of each frame over the pixels that count, and LPIPS, of images black elsewhere, where it is measured. A frame that it cannot compare has none; the log says
    /// why.
    ///
    /// # Errors
    /// Errors of the renderer and of `before_each`; a photograph that cannot be read back.
    pub fn scores(
        self,
        frames: &[&Frame],
        lpips: Option<&dyn PerceptualDistance>,
    ) -> Result<Vec<ViewScore>, E> {
        self.compare(frames, in_flight(lpips), &|frame, render, target| {
            score_with(lpips, &frame.name, render, target)
        })
    }

    /// As [`Self::scores`], with the right halves of the views that have figures of them.
    ///
    /// # Errors
    /// As [`Self::scores`].
    pub fn scores_with_halves(
        self,
        frames: &[&Frame],
        lpips: Option<&dyn PerceptualDistance>,
    ) -> Result<(Vec<ViewScore>, Vec<RightHalf>), E> {
        let both = self.compare(frames, in_flight(lpips), &|frame, render, target| {
            Some((score_with(lpips, &frame.name, render, target)?, target.right_half(render)))
        })?;
        let (scores, halves): (Vec<_>, Vec<_>) = both.into_iter().unzip();
        Ok((scores, halves.into_iter().flatten().collect()))
    }

    /// The mean PSNR of the frames, without the time that SSIM takes; `None` without frames.
    ///
    /// # Errors
    /// As [`ViewMeasurement::scores`].
    pub fn mean_psnr(self, frames: &[&Frame]) -> Result<Option<f64>, E> {
        let values = self.compare(frames, InFlight::Several, &|_, render, target| target.psnr(render))?;
        Ok(mean(&values))
    }

    fn compare<T: Send>(
        self,
        frames: &[&Frame],
        in_flight: InFlight,
        compare: &(dyn Fn(&Frame, &Image, &Target) -> Option<T> + Sync),
    ) -> Result<Vec<T>, E> {
        let Self { renderer, background, before_each } = self;
        let mut views = renderer.views(frames.iter().map(|frame| frame.camera));
        let mut compared = Vec::with_capacity(frames.len());
        let tasks = ViewTasks::<T, E> {
            render: &mut |frame| {
                before_each()?;
                let no_view = || RenderError::Scene(format!("frame {} has no view", frame.name));
                Ok(views.next().ok_or_else(no_view)??)
            },
            process: &|frame, render| {
                let target = Target::of(frame, background).map_err(RenderError::from)?;
                let size = || RenderError::Scene(format!("frame {} is not of its camera's size", frame.name));
                Ok(compare(frame, &render, &target).ok_or_else(size)?)
            },
            collect: &mut |result| {
                compared.push(result);
                Ok(())
            },
        };
        for_each_view(frames, in_flight, tasks)?;
        Ok(compared)
    }
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

fn in_flight(lpips: Option<&dyn PerceptualDistance>) -> InFlight {
    // LPIPS has some 300 bytes per pixel.
    if lpips.is_some() { InFlight::One } else { InFlight::Several }
}

fn score_with(
    lpips: Option<&dyn PerceptualDistance>,
    name: &str,
    render: &Image,
    target: &Target,
) -> Option<ViewScore> {
    let mut score = target.score(name, render)?;
    score.lpips = lpips.and_then(|lpips| {
        let distance = lpips.distance(&target.masked(render), target.photograph());
        distance.inspect_err(|error| tracing::warn!("{name}: no LPIPS: {}", error.detail)).ok()
    });
    Some(score)
}

/// PSNR and SSIM of each frame, photographs composited on `background`.
///
/// # Errors
/// As [`ViewMeasurement::scores`].
pub fn measure_views(
    renderer: &mut Renderer,
    frames: &[&Frame],
    background: Background,
) -> Result<Vec<ViewScore>, RenderError> {
    ViewMeasurement { renderer, background, before_each: &mut || Ok(()) }.scores(frames, None)
}

/// The mean PSNR of training views in dB, of renders as their corrections make them; 0 without views.
///
/// # Errors
/// As [`ViewMeasurement::scores`].
pub fn mean_psnr(
    renderer: &mut Renderer,
    views: &[TrainView<'_>],
    background: Background,
) -> Result<f64, RenderError> {
    let before_each: &mut dyn FnMut() -> Result<(), RenderError> = &mut || Ok(());
    let measurement = ViewMeasurement { renderer, background, before_each };
    let frames: Vec<&Frame> = views.iter().map(|view| view.frame).collect();
    let correction = |frame: &Frame| -> Option<ColorFit> {
        views.iter().find(|view| std::ptr::eq(view.frame, frame))?.correction
    };
    let values = measurement.compare(
        &frames,
        InFlight::Several,
        &|frame, render, target| match correction(frame) {
            Some(fit) => target.psnr(&fit.image(render)?),
            None => target.psnr(render),
        },
    )?;
    Ok(mean(&values).unwrap_or(0.0))
}
