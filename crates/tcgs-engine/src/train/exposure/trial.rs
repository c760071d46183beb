//! Decides `exposure=auto` by training views that a short run is not trained on (METHOD.md §2.11).
//!
//! The run of the trial shares nothing with the run that follows, which has the bits of `exposure=on` or of `exposure=off`. Held-out
//! views have no part in it.

use std::sync::Arc;

use crate::{
    domain::{
        CancelFlag, Dataset, Exposure, ExposureChoice, ExposureTrial, Frame, Layout, ModelKind, Progress,
        Scene, Split, TrainOptions, evenly_spaced::evenly_spaced,
    },
    eval::{ColorFit, InFlight, LeftHalf, Target, ViewTasks, for_each_view},
    gpu::Device,
    render::Renderer,
    train::{Result, Schedule, TrainError, Trained},
};

/// The gain in dB from which corrections are on.
const NEEDED_GAIN: f64 = 0.5;

/// Runs of fewer steps have no trial, which would take a large share of them.
const MIN_STEPS: u32 = 500;

/// Fewest training views of which some can be set aside.
const MIN_VIEWS: usize = 6;

/// Every so many training views one is set aside, at least and at most so many.
const ASIDE_EVERY: usize = 8;
const MIN_ASIDE: usize = 2;
const MAX_ASIDE: usize = 8;

/// Steps of the trial: this part of the run's, at most so many.
const STEPS_SHARE: u32 = 5;
const MAX_TRIAL_STEPS: u32 = 200;

/// Trains a scene from a dataset with options; calls the last argument every few steps.
pub(in crate::train) type ShortRun<'a> =
    dyn Fn(&Dataset, &TrainOptions, &mut dyn FnMut(&Progress)) -> Result<Trained> + 'a;

/// What a trial needs.
pub(in crate::train) struct Trial<'a> {
    pub(in crate::train) device: &'a Arc<Device>,
    pub(in crate::train) dataset: &'a Dataset,
    pub(in crate::train) options: &'a TrainOptions,
    pub(in crate::train) cancel: &'a CancelFlag,
    pub(in crate::train) train: &'a ShortRun<'a>,
}

/// Whether a run from the start learns corrections. `report` is called every few steps of a trial.
///
/// # Errors
/// [`TrainError::Cancelled`], and errors of the device and of photographs.
pub(in crate::train) fn choose(
    trial: &Trial<'_>,
    report: &mut dyn FnMut(&Progress),
) -> Result<ExposureChoice> {
    let choice = match trial.options.exposure {
        Exposure::Off => return Ok(ExposureChoice::OFF),
        Exposure::On => ExposureChoice::ON,
        Exposure::Auto if !trial.is_possible() => return Ok(ExposureChoice::OFF),
        Exposure::Auto => trial.run(report)?,
    };
    let state = if choice.corrected { "on" } else { "off" };
    tracing::info!("color corrections are {state}: {}", choice.because());
    Ok(choice)
}

impl Trial<'_> {
    /// Whether the dataset is one of photographs and the run is long enough.
    fn is_possible(&self) -> bool {
        let frames = self.dataset.split(Split::Train);
        self.dataset.layout != Layout::Blender
            && self.dataset.frames.iter().all(|frame| !frame.image.has_alpha())
            && frames.count() >= MIN_VIEWS
            && self.steps() >= MIN_STEPS
    }

    /// Steps of the run.
    fn steps(&self) -> u32 {
        Schedule::new(self.options).steps
    }

    fn run(&self, report: &mut dyn FnMut(&Progress)) -> Result<ExposureChoice> {
        let (dataset, aside) = without_some(self.dataset);
        let scene = match self.scene(&dataset, report) {
            Ok(scene) => scene,
            Err(error @ (TrainError::NothingLeft { .. } | TrainError::Diverged { .. })) => {
                tracing::warn!("color corrections are off, since their trial found no scene: {error}");
                return Ok(ExposureChoice::OFF);
            }
            Err(error) => return Err(error),
        };
        let gains = self.gains(&scene, &aside)?;
        if gains.is_empty() {
            tracing::warn!(
                "color corrections are off, since masks hide half of every view that their trial set aside"
            );
            return Ok(ExposureChoice::OFF);
        }
        let gain = gains.iter().sum::<f64>() / gains.len() as f64;
        Ok(ExposureChoice::by(ExposureTrial { views: gains.len(), gain, needed: NEEDED_GAIN }))
    }

    /// The scene of a short run without corrections and without anything that only shrinks files.
    fn scene(&self, dataset: &Dataset, report: &mut dyn FnMut(&Progress)) -> Result<Scene> {
        let (total, steps) = (self.steps(), (self.steps() / STEPS_SHARE).min(MAX_TRIAL_STEPS));
        let TrainOptions { seed, background, model, .. } = *self.options;
        let options = TrainOptions {
            model: if model == ModelKind::Tcgs { ModelKind::Scaffold } else { model },
            iterations: Some(steps),
            seed,
            background,
            exposure: Exposure::Off,
            ..TrainOptions::default()
        };
        let trained = (self.train)(dataset, &options, &mut |progress| {
            // The run itself has not begun.
            report(&Progress {
                total: u64::from(total),
                elapsed_seconds: progress.elapsed_seconds,
                ..Progress::default()
            });
        })?;
        Ok(trained.scene)
    }

    /// PSNR in dB over the right halves of views that corrections of their left halves gain over the one that fits all left halves at
    /// once. The common one makes up for what a scene of few steps lacks; exposures that differ it cannot make up for. Views of which
    /// one half has no pixel that counts have no gain.
    fn gains(&self, scene: &Scene, aside: &[&Frame]) -> Result<Vec<f64>> {
        let background = self.options.background;
        let mut renderer = Renderer::of_scene(self.device, scene, background)?;
        let mut views = Vec::new();
        let tasks = ViewTasks::<_, TrainError> {
            render: &mut |frame| match self.cancel.is_cancelled() {
                true => Err(TrainError::Cancelled),
                false => Ok(renderer.render(&frame.camera)?),
            },
            process: &|frame, render| {
                let target = Target::of(frame, background)?;
                let half = target.left_half(&render);
                Ok(half.map(|half| (target, render, half)))
            },
            collect: &mut |view| {
                views.extend(view);
                Ok(())
            },
        };
        for_each_view(aside, InFlight::Several, tasks)?;
        let common = views.iter().fold(LeftHalf::default(), |sum, (_, _, half)| sum.plus(half)).fit();
        let gains = views.iter().filter_map(|(target, render, half)| {
            let psnr = |fit: ColorFit| target.right_half_psnr(render, Some(&fit));
            Some(psnr(half.fit())? - psnr(common)?)
        });
        Ok(gains.collect())
    }
}

/// The dataset without some of its training views, which are returned.
fn without_some(dataset: &Dataset) -> (Dataset, Vec<&Frame>) {
    let train: Vec<&Frame> = dataset.split(Split::Train).collect();
    let count = (train.len() / ASIDE_EVERY).clamp(MIN_ASIDE, MAX_ASIDE);
    let aside: Vec<&Frame> = evenly_spaced(&train, count).copied().collect();
    let is_aside = |frame: &Frame| aside.iter().any(|other| other.name == frame.name);
    let frames = dataset.frames.iter().filter(|frame| frame.split == Split::Train && !is_aside(frame));
    (Dataset { frames: frames.cloned().collect(), ..dataset.clone() }, aside)
}
