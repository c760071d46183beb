//! The part of a training run that differs between the kinds of model.
//!
//! The training loop owns photographs, rasterizer and losses; a [`ModelTrainer`] turns its parameters into the Gaussians of a
//! view, and the loss's gradients by those Gaussians into its next parameters. Invariants: the state after a step depends only on
//! the state before it, the camera, the step and the random generator; and a trainer made from the state that
//! [`ModelTrainer::save`] returned continues with the same bits.

use rand_pcg::Pcg64;

use super::{
    ColorCorrections, Result, SizeAim, checkpoint::ModelState, photographs::Photographs,
    trained::TrainedContext,
};
use crate::{
    domain::{Background, Camera, CancelFlag, Frame, Scene},
    gpu::{Buffer, Device, Recorder},
    render::{CorrectionRows, GaussianGradients, Gaussians, Rasterizer},
};

/// A step's place in the run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Step {
    /// From 1.
    pub number: u32,
    /// The share of the schedule that is done after it, in (0, 1].
    pub fraction: f64,
    /// Weight of the rate term in the loss.
    pub lambda: f64,
    /// Of a run with a target size.
    pub size_aim: Option<SizeAim>,
}

/// The training views, for passes over them that end once the run is cancelled.
pub(super) struct Views<'a> {
    /// Free between the passes of two steps.
    pub raster: &'a mut Rasterizer,
    /// The training photographs, with cameras in the scene's frame.
    pub frames: &'a [Frame],
    /// The photographs of `frames`, as the loss reads them.
    pub photographs: &'a mut Photographs,
    /// The color corrections of `frames`, if the run learns them.
    pub corrections: Option<&'a ColorCorrections>,
    pub background: Background,
    pub cancel: &'a CancelFlag,
}

impl Views<'_> {
    /// The color correction of each frame, in a run that learns them. Waits for the device.
    pub(super) fn read_corrections(&self) -> Result<Option<Vec<CorrectionRows>>> {
        Ok(self.corrections.map(ColorCorrections::read).transpose()?)
    }
}

/// Submits what `record` records, a forward pass of `raster` at its end, until there is room for all intersections. Waits for the device.
pub(super) fn submit_with_room(
    device: &Device,
    raster: &mut Rasterizer,
    mut record: impl FnMut(&mut Rasterizer, &mut Recorder<'_>) -> Result<()>,
) -> Result<()> {
    loop {
        let mut recorder = device.recorder("view to measure");
        record(raster, &mut recorder)?;
        recorder.submit()?;
        match raster.take_forward_passes()?.required {
            None => return Ok(()),
            Some(needed) => raster.reserve(needed)?,
        }
    }
}

/// How large a model is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ModelSize {
    /// Anchors; zero in a model that has none.
    pub anchors: usize,
    /// Gaussians of the last view; none before the first one of a model that makes them for each view.
    pub gaussians: Option<usize>,
}

/// The file's size, as the last sample of anchors suggests it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct BitrateSample {
    /// Mean bits of an anchor's attributes.
    pub bits_per_anchor: f64,
    /// Approximate bytes of everything else in the file.
    pub other_bytes: f64,
}

/// Buffers that hold figures of the last submitted step.
#[derive(Debug, Clone, Default)]
pub(super) struct FigureBuffers {
    /// Candidate Gaussians of its view, those of positive opacity, visible anchors; in a model that makes Gaussians for each view.
    pub counts: Option<Buffer<u32>>,
    /// Bits of the sample of anchors by attribute group, if the loss has a rate term.
    pub bits: Option<Buffer<f32>>,
}

/// The result of a [`ModelTrainer`].
#[derive(Debug, Clone)]
pub(super) struct FinishedModel {
    pub scene: Scene,
    /// With its attributes before they were rounded, if they were.
    pub unrounded: Option<Scene>,
    /// None for models without a context model.
    pub context: Option<TrainedContext>,
}

/// A model in training; see the module's documentation.
pub(super) trait ModelTrainer {
    /// Records the Gaussians that `camera` sees.
    fn forward(&mut self, recorder: &mut Recorder<'_>, camera: &Camera, step: &Step) -> Result<()>;

    /// What the last [`ModelTrainer::forward`] recorded.
    fn gaussians(&self) -> &Gaussians;

    /// The buffers that the rasterizer writes the loss's gradients by those Gaussians to.
    fn gaussian_gradients(&mut self) -> Result<GaussianGradients>;

    /// Records the gradients by the parameters, the statistics that growth goes by, and the optimizer's step. If `overflow_flag` is
    /// set by the time that these are run, the step will be repeated, so nothing of it may persist.
    fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        step: &Step,
        overflow_flag: &Buffer<u32>,
    ) -> Result<()>;

    /// Some pixels of the photographs do not count: from now on, growth goes by views that give a gradient alone.
    fn count_views_with_gradient(&mut self) -> Result<()>;

    /// Whether the schedule wants [`ModelTrainer::adapt`] after a step.
    fn adapts(&self, step: &Step) -> bool;

    /// The trainer that takes over after a step, before it adapts, where another stage of the run begins. Waits for the device.
    fn successor(&self, _step: &Step, _rng: &mut Pcg64) -> Result<Option<Box<dyn ModelTrainer>>> {
        Ok(None)
    }

    /// Grows, prunes and resets after a submitted step. May wait for the device; ends as [`super::TrainError::Cancelled`] if the run
    /// is cancelled during a long pass over `views`.
    fn adapt(&mut self, step: &Step, rng: &mut Pcg64, views: &mut Views<'_>) -> Result<()>;

    /// Anchors; zero in a model that has none.
    fn anchors(&self) -> usize;

    /// Where the figures of the last submitted step are.
    fn figures(&self) -> FigureBuffers;

    /// The model's size; `counts` are those of [`FigureBuffers`].
    fn size(&self, counts: Option<&[u32]>) -> ModelSize;

    /// The file's size by the sample of `step`, whose `bits` are those of [`FigureBuffers`].
    fn bitrate(&self, step: u32, bits: &[f32]) -> Result<Option<BitrateSample>>;

    /// Everything that the next step depends on. Waits for the device.
    fn save(&self) -> Result<ModelState>;

    /// The finished scene.
    fn finish(self: Box<Self>, views: &mut Views<'_>) -> Result<FinishedModel>;
}
