//! Looks at the model in training: pictures of one view, and PSNR of a few, each within a share of the run's time.
//!
//! Invariant: no bit of the result depends on it. It renders between steps, while nothing is in flight, and writes only buffers that each
//! step writes anew. So what it shows is the model as the next step renders it.

use std::{sync::Arc, time::Instant};

use super::{
    Result,
    model_trainer::{ModelTrainer, Step, submit_with_room},
};
use crate::{
    domain::{
        Background, Camera, Dataset, Frame, Image, Preview, SceneFrame, Split, evenly_spaced::evenly_spaced,
    },
    eval::{Target, shrunk},
    gpu::{Device, KernelVariant},
    render::{Rasterizer, RenderError},
};

/// Shares of the run's time.
const PICTURES_SHARE: f64 = 0.01;
const FIGURES_SHARE: f64 = 0.02;
/// Views whose PSNR is measured.
const MEASURED: usize = 4;
/// Longest side of pictures on a software adapter and on others.
const SOFTWARE_SIDE: u32 = 256;
const HARDWARE_SIDE: u32 = 512;

/// Time spent on something that may take a share of the whole.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Allowance {
    share: f64,
    spent: f64,
}

impl Allowance {
    /// Whether more may be spent after so many seconds.
    fn is_left(self, elapsed: f64) -> bool {
        self.spent <= self.share * elapsed
    }
}

/// Fixed views of a run: held-out ones or, without any, training ones.
pub(super) struct Monitor {
    device: Arc<Device>,
    background: Background,
    /// With cameras in the scene's frame; the first one is shown.
    views: Vec<Frame>,
    /// The latest mean PSNR of the views.
    psnr: Option<f64>,
    started: Instant,
    pictures: Allowance,
    figures: Allowance,
    /// The photograph beside the pictures, once there was one.
    photograph: Option<Arc<Image>>,
    /// The latest picture, until it is reported.
    preview: Option<Preview>,
}

impl Monitor {
    pub(super) fn new(
        device: &Arc<Device>,
        dataset: &Dataset,
        frame: SceneFrame,
        background: Background,
    ) -> Self {
        let of = |split| dataset.split(split).collect::<Vec<_>>();
        let held_out = of(Split::Test);
        let all = if held_out.is_empty() { of(Split::Train) } else { held_out };
        let inside =
            |view: &&Frame| Frame { camera: frame.camera_from_world(&view.camera), ..(*view).clone() };
        let views: Vec<Frame> = evenly_spaced(&all, MEASURED).map(inside).collect();
        Self {
            device: Arc::clone(device),
            background,
            psnr: None,
            views,
            started: Instant::now(),
            pictures: Allowance { share: PICTURES_SHARE, spent: 0.0 },
            figures: Allowance { share: FIGURES_SHARE, spent: 0.0 },
            photograph: None,
            preview: None,
        }
    }

    /// Whether there is time for a look, so that the run should pause after its next step.
    pub(super) fn is_due(&self) -> bool {
        let elapsed = self.elapsed();
        !self.views.is_empty() && (self.pictures.is_left(elapsed) || self.figures.is_left(elapsed))
    }

    fn elapsed(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    /// Looks at the model after a step as far as there is time, or at all views after the last one. Waits for the device. A photograph that
    /// cannot be read ends the looking, not the run.
    pub(super) fn look(
        &mut self,
        model: &mut dyn ModelTrainer,
        raster: &mut Rasterizer,
        step: &Step,
        is_last: bool,
    ) -> Result<()> {
        if self.views.is_empty() {
            return Ok(());
        }
        if is_last || self.pictures.is_left(self.elapsed()) {
            let began = Instant::now();
            self.picture(model, raster, step)?;
            self.pictures.spent += began.elapsed().as_secs_f64();
        }
        if is_last || self.figures.is_left(self.elapsed()) {
            let began = Instant::now();
            self.measure(model, raster, step)?;
            self.figures.spent += began.elapsed().as_secs_f64();
        }
        Ok(())
    }

    fn picture(&mut self, model: &mut dyn ModelTrainer, raster: &mut Rasterizer, step: &Step) -> Result<()> {
        let Some(view) = self.views.first() else { return Ok(()) };
        let side = match self.device.variant() {
            KernelVariant::Software => SOFTWARE_SIDE,
            KernelVariant::Hardware => HARDWARE_SIDE,
        };
        if self.photograph.is_none() {
            let target = Target::of(view, self.background);
            let small = target.map(|target| shrunk(target.photograph(), side));
            let Ok(Some(small)) = small else {
                self.give_up("a photograph cannot be read or has no colors");
                return Ok(());
            };
            self.photograph = Some(Arc::new(small));
        }
        let Some(photograph) = self.photograph.clone() else { return Ok(()) };
        let render = Arc::new(self.render(model, raster, &view.camera.within(side), step)?);
        self.preview = Some(Preview { render, photograph });
        Ok(())
    }

    fn give_up(&mut self, why: &str) {
        tracing::warn!("progress has neither pictures nor figures of the model any more: {why}");
        self.views.clear();
        self.psnr = None;
    }

    fn measure(&mut self, model: &mut dyn ModelTrainer, raster: &mut Rasterizer, step: &Step) -> Result<()> {
        // All of them at each look: a mean of some, or of earlier figures and later ones, would not be that of one model.
        let mut all = Vec::new();
        for view in &self.views {
            let render = self.render(model, raster, &view.camera, step)?;
            match Target::of(view, self.background) {
                Ok(target) => all.extend(target.psnr(&render)),
                Err(error) => {
                    self.give_up(&error.to_string());
                    return Ok(());
                }
            }
        }
        self.psnr = (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64);
        Ok(())
    }

    fn render(
        &self,
        model: &mut dyn ModelTrainer,
        raster: &mut Rasterizer,
        camera: &Camera,
        step: &Step,
    ) -> Result<Image> {
        submit_with_room(&self.device, raster, |raster, recorder| {
            model.forward(recorder, camera, step)?;
            Ok(raster.forward(recorder, model.gaussians(), camera, self.background.rgb())?)
        })?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let pixels = self.device.read(raster.image())?;
        let level = |value: f32| (255.0 * value.clamp(0.0, 1.0) + 0.5) as u8;
        let samples = pixels.iter().flat_map(|[r, g, b, _]| [level(*r), level(*g), level(*b)]);
        let image = Image::new(width, height, 3, samples.collect());
        Ok(image.map_err(|error| RenderError::Scene(error.to_string()))?)
    }

    /// The same with time for another look at everything.
    #[cfg(test)]
    pub(super) fn with_time(self) -> Self {
        let [pictures, figures] = [self.pictures, self.figures].map(|all| Allowance { spent: 0.0, ..all });
        Self { pictures, figures, ..self }
    }

    /// The mean PSNR of the views at the latest look; `None` before the first.
    pub(super) fn psnr(&self) -> Option<f64> {
        self.psnr
    }

    /// The latest picture, once.
    pub(super) fn take_preview(&mut self) -> Option<Preview> {
        self.preview.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_of_the_time_may_be_spent() {
        let mut allowance = Allowance { share: 0.01, spent: 0.0 };
        assert!(allowance.is_left(0.0), "the first look is at the beginning");
        allowance.spent = 0.5;
        assert!(!allowance.is_left(49.0) && allowance.is_left(50.0));
    }
}
