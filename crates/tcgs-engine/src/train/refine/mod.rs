//! Refines plain Gaussians until their views are those of another scene, whose renders stand in for photographs.
//!
//! Nothing grows and nothing is pruned. A picture is rendered for each step and then forgotten, so memory does not depend on the number
//! of cameras. The same scenes, cameras and adapter give the same bits.

mod poses;

use std::sync::Arc;

use poses::Poses;

use super::{Adam, AdamStep, ImageLoss, Moments, Result, TrainError, photographs::pack};
use crate::{
    domain::{Background, Camera, GaussianScene, Scene, evenly_spaced::evenly_spaced},
    gpu::{Buffer, Device, Recorder},
    model::{
        GaussianRows,
        gaussian_rows::{self, BASE, band_values},
    },
    render::{DeviceGaussians, PlainGaussians, RasterSettings, Rasterizer, Renderer},
};

/// Longer side of the pictures that are compared, at most.
const MAX_SIDE: u32 = 1024;

/// Most cameras that are looked from. Neighbors are searched among all pairs of them.
const MAX_CAMERAS: usize = 1024;

/// Seed of the order of views.
const SEED: u64 = 0;

/// Learning rates at the first step. Those of 3D Gaussian splatting are the same, but for coefficients, which have no time to grow, and
/// for means, which are in place already.
const COLOR: f32 = 0.0025;
const COEFFICIENTS: f32 = 0.001;
const OPACITY: f32 = 0.05;
const LOG_SCALE: f32 = 0.005;
const QUAT: f32 = 0.001;

/// The same of means, in depths of the near plane, which is measured in the scene's extent.
const MEAN: f32 = 8e-5;

/// What is left of the rates at the last step.
const LAST_SHARE: f64 = 0.1;

/// What the Gaussians are to look like.
pub struct Refinement<'a> {
    /// The scene that they stand for, in the same frame.
    pub scene: &'a Scene,
    /// Behind both.
    pub background: Background,
    /// Where it is looked at from, in the world.
    pub cameras: &'a [Camera],
    /// How many views are compared.
    pub steps: u32,
}

impl Refinement<'_> {
    /// The Gaussians, refined; as many as before. `report` is told of each finished step.
    ///
    /// # Errors
    /// [`TrainError::Diverged`]; faults of the device.
    pub fn of(
        &self,
        device: &Arc<Device>,
        gaussians: &GaussianScene,
        report: &dyn Fn(u32),
    ) -> Result<GaussianScene> {
        let cameras = evenly_spaced(self.cameras, MAX_CAMERAS);
        let cameras: Vec<Camera> = cameras.map(|camera| camera.within(MAX_SIDE)).collect();
        let mut poses = Poses::new(cameras, SEED);
        let mut source = Renderer::of_scene(device, self.scene, self.background)?;
        let mut fit = Fit::new(device, gaussians, self.background)?;
        for step in 1..=self.steps {
            let Some(camera) = poses.next() else { break };
            let picture = pack(source.render(&camera)?.samples());
            let camera = self.scene.frame().camera_from_world(&camera);
            fit.step(&camera, &picture, step, f64::from(step) / f64::from(self.steps))?;
            report(step);
        }
        fit.finish(gaussians, self.steps)
    }
}

/// The Gaussians and their optimizer.
struct Fit {
    device: Arc<Device>,
    background: Background,
    near: f32,
    rows: DeviceGaussians,
    gradients: DeviceGaussians,
    first: DeviceGaussians,
    second: DeviceGaussians,
    plain: PlainGaussians,
    raster: Rasterizer,
    loss: ImageLoss,
    adam: Adam,
    picture: Option<Buffer<u32>>,
}

impl Fit {
    fn new(device: &Arc<Device>, gaussians: &GaussianScene, background: Background) -> Result<Self> {
        let near = gaussians.near.depth();
        let zero = || DeviceGaussians::plan(gaussians.len()).make(device);
        let mut plain = PlainGaussians::new(Arc::clone(device), near)?;
        plain.set_degree(u32::from(gaussians.degree))?;
        Ok(Self {
            background,
            near,
            rows: DeviceGaussians::upload(device, &GaussianRows::from_scene(gaussians))?,
            gradients: zero()?,
            first: zero()?,
            second: zero()?,
            plain,
            raster: Rasterizer::new(
                Arc::clone(device),
                RasterSettings { near, ..RasterSettings::default() },
            )?,
            loss: ImageLoss::new(Arc::clone(device))?,
            adam: Adam::new(device)?,
            picture: None,
            device: Arc::clone(device),
        })
    }

    /// One step towards `picture`, which is repeated until there is room for all intersections. Waits for the device.
    fn step(&mut self, camera: &Camera, picture: &[u32], step: u32, fraction: f64) -> Result<()> {
        loop {
            let device = Arc::clone(&self.device);
            let mut recorder = device.recorder("refinement");
            self.record(&mut recorder, camera, picture, step, fraction)?;
            recorder.submit()?;
            match self.raster.take_forward_passes()?.required {
                None => return Ok(()),
                Some(needed) => self.raster.reserve(needed)?,
            }
        }
    }

    fn record(
        &mut self,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        picture: &[u32],
        step: u32,
        fraction: f64,
    ) -> Result<()> {
        let buffer = match self.picture.take().filter(|buffer| buffer.len() >= picture.len()) {
            Some(buffer) => buffer,
            None => self.device.buffer("picture of the scene", picture.len())?,
        };
        recorder.write(&buffer, picture);
        self.plain.forward(recorder, &self.rows, camera)?;
        self.raster.forward(recorder, self.plain.gaussians(), camera, self.background.rgb())?;
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        let picture = self.picture.insert(buffer).first(picture.len());
        let d_image = self.loss.record(recorder, size, self.raster.image(), &picture, None)?;
        let gaussians = self.plain.gaussians().clone();
        let d_gaussians = self.plain.gaussian_gradients()?.clone();
        self.raster.backward(recorder, &gaussians, camera, d_image, &d_gaussians)?;
        self.plain.backward(recorder, &self.rows, &self.gradients)?;
        self.learn(recorder, step, fraction)
    }

    fn learn(&self, recorder: &mut Recorder<'_>, number: u32, fraction: f64) -> Result<()> {
        let overflow_flag = self.raster.overflow_flag();
        let decay = (1.0 - fraction * (1.0 - LAST_SHARE)) as f32;
        let mut rates = [COLOR; BASE];
        rates[..gaussian_rows::LOG_SCALE].fill(MEAN * self.near);
        rates[gaussian_rows::LOG_SCALE..gaussian_rows::QUAT].fill(LOG_SCALE);
        rates[gaussian_rows::QUAT..gaussian_rows::OPACITY].fill(QUAT);
        rates[gaussian_rows::OPACITY..gaussian_rows::COLOR].fill(OPACITY);
        let learning_rates = recorder.uniform(&rates.map(|rate| decay * rate))?;
        let step = AdamStep { number, overflow_flag };
        let (gradients, rows) = (&self.gradients, &self.rows);
        let moments = Moments { first: self.first.base.clone(), second: self.second.base.clone() };
        self.adam.step(recorder, step, &learning_rates, &gradients.base, &rows.base, &moments)?;
        let in_use = rows.count * band_values(self.plain.degree() as usize);
        if in_use > 0 {
            let learning_rates = recorder.uniform(&[decay * COEFFICIENTS])?;
            let moments = Moments { first: self.first.bands.clone(), second: self.second.bands.clone() };
            let bands = rows.bands.first(in_use);
            self.adam.step(recorder, step, &learning_rates, &gradients.bands, &bands, &moments)?;
        }
        Ok(())
    }

    fn finish(self, before: &GaussianScene, step: u32) -> Result<GaussianScene> {
        let rows = self.rows.download(&self.device)?;
        let scene = rows.to_scene(self.plain.degree() as usize);
        let scene = GaussianScene { near: before.near, frame: before.frame, ..scene };
        scene.check().map_err(|_| TrainError::Diverged { step })?;
        Ok(scene)
    }
}

#[cfg(test)]
mod tests;
