//! The importance of each Gaussian and anchor: the increase of the views' squared error without it.
//!
//! The error is that of training: of renders through their photographs' color corrections, over the pixels that count.
//!
//! A pixel's color C is linear in the opacity o of each of its Gaussians, so leaving one out changes it by exactly
//! -o dC/do, and the sum of squares by that change's square and its product with twice the error that is there already. One
//! backward pass with that error as the image's gradient sums the products. One with random signs as the gradient gives a
//! number whose expected square is the sum of squares over all pixels (Hutchinson's estimator): no per-pixel list is ever
//! needed. The offsets of an anchor are added before the square, so that those which cover the same pixels count as one.

use std::{ops::Range, sync::Arc};

use super::{removal_signs::signs, train_view::TrainView};
use crate::{
    domain::{AnchorScene, Background, Camera, SceneFrame},
    gpu::Device,
    model::{AnchorRows, ModelShape, NetworkLayout},
    render::{DeviceAnchors, NeuralGaussians, RasterSettings, Rasterizer, RenderError},
};

/// Probes with random signs that all views are given together, at least: with these, what they add up to is right within a
/// fifth or so for each Gaussian, which is enough to put Gaussians into an order.
const PROBES: usize = 64;

/// Increase of the squared error, summed over channels and pixels that count of the views; below zero where leaving out would help.
#[derive(Debug, Clone, PartialEq)]
pub struct RemovalCosts {
    /// `[N][K]`: of each offset alone.
    pub offsets: Vec<f64>,
    /// `[N]`: of each anchor with all its offsets.
    pub anchors: Vec<f64>,
}

/// Measures the increase of the squared error on `views`, of renders as their corrections make them; zero for Gaussians that none of them
/// shows where pixels count. The same scene and views give the same values on one adapter. Calls `keep_going` between views; once it
/// returns false, only the views so far count.
///
/// # Errors
/// Errors of the renderer; a photograph that cannot be read back.
pub fn removal_costs(
    device: &Arc<Device>,
    scene: &AnchorScene,
    views: &[TrainView<'_>],
    background: Background,
    keep_going: &mut dyn FnMut() -> bool,
) -> Result<RemovalCosts, RenderError> {
    let mut probe = Probe::new(device, scene, background)?;
    let k = scene.offsets_per_anchor;
    let mut costs = RemovalCosts { offsets: vec![0.0; scene.len() * k], anchors: vec![0.0; scene.len()] };
    let probes = PROBES.div_ceil(views.len().max(1)) as u32;
    for (number, view) in (0..).zip(views) {
        if !keep_going() {
            break;
        }
        probe.add(view, number * probes..(number + 1) * probes, &mut costs)?;
    }
    Ok(costs)
}

/// The Gaussians of a view.
struct Visible<'a> {
    list: &'a [u32],
    opacities: &'a [f32],
    offsets: usize,
}

impl Visible<'_> {
    /// Adds to each offset and anchor what `cost` makes of the sum of opacity times gradient.
    fn add(&self, gradients: &[f32], costs: &mut RemovalCosts, cost: impl Fn(f64) -> f64) {
        let k = self.offsets;
        for (place, anchor) in self.list.iter().enumerate() {
            let mut whole = 0.0;
            for offset in 0..k {
                let row = place * k + offset;
                let change = f64::from(self.opacities[row]) * f64::from(gradients[row]);
                costs.offsets[*anchor as usize * k + offset] += cost(change);
                whole += change;
            }
            costs.anchors[*anchor as usize] += cost(whole);
        }
    }
}

struct Probe<'a> {
    device: &'a Arc<Device>,
    anchors: DeviceAnchors,
    neural: NeuralGaussians,
    raster: Rasterizer,
    background: Background,
    frame: SceneFrame,
}

impl<'a> Probe<'a> {
    fn new(
        device: &'a Arc<Device>,
        scene: &AnchorScene,
        background: Background,
    ) -> Result<Self, RenderError> {
        let shape = ModelShape::of(scene);
        shape.check().map_err(RenderError::Scene)?;
        let networks =
            NetworkLayout::new(shape).from_networks(&scene.networks).map_err(RenderError::Scene)?;
        let settings = RasterSettings { near: scene.near.depth(), ..RasterSettings::default() };
        Ok(Self {
            device,
            anchors: DeviceAnchors::upload(device, &AnchorRows::from_scene(scene), &networks)?,
            neural: NeuralGaussians::new(Arc::clone(device), shape, settings.near, scene.scene_scale)?,
            raster: Rasterizer::new(Arc::clone(device), settings)?,
            background,
            frame: scene.frame,
        })
    }

    /// Adds one view, probed once by each of `numbers`.
    fn add(
        &mut self,
        view: &TrainView<'_>,
        numbers: Range<u32>,
        costs: &mut RemovalCosts,
    ) -> Result<(), RenderError> {
        let camera = &self.frame.camera_from_world(&view.frame.camera);
        self.render(camera)?;
        let photograph = view.frame.image.load()?.over(self.background.rgb8());
        let image = self.device.read(self.raster.image())?;
        let mut error: Vec<[f32; 4]> = image
            .iter()
            .zip(photograph.samples().chunks_exact(3))
            .map(|(pixel, wanted)| {
                let compared = view.compared(*pixel);
                let twice = |channel: usize| 2.0 * (compared[channel] - f32::from(wanted[channel]) / 255.0);
                [twice(0), twice(1), twice(2), 0.0]
            })
            .collect();
        view.gradient_by_render(&mut error);
        let by_error = self.opacity_gradients(camera, &error)?;
        let (visible, opacities) = self.neural.visible_opacities()?;
        let shown = Visible { list: &visible, opacities: &opacities, offsets: self.anchors.shape.offsets };
        shown.add(&by_error, costs, |change| -change);
        let share = 1.0 / f64::from(numbers.end - numbers.start);
        for number in numbers {
            let mut signs = signs(number, image.len());
            view.gradient_by_render(&mut signs);
            let by_signs = self.opacity_gradients(camera, &signs)?;
            shown.add(&by_signs, costs, |change| share * change * change);
        }
        Ok(())
    }

    fn render(&mut self, camera: &Camera) -> Result<(), RenderError> {
        self.raster.submit_with_room("view to probe", |raster, recorder| {
            self.neural.forward(recorder, &self.anchors, camera, 0.0)?;
            raster.forward(recorder, self.neural.gaussians(), camera, self.background.rgb())
        })?;
        Ok(())
    }

    /// The gradients by the opacities of the view's Gaussians where `d_image` are those by its pixels.
    fn opacity_gradients(&mut self, camera: &Camera, d_image: &[[f32; 4]]) -> Result<Vec<f32>, RenderError> {
        let d_image = self.device.upload("gradient of a probe", d_image)?;
        let gaussians = self.neural.gaussians().clone();
        let gradients = self.neural.gaussian_gradients()?.clone();
        let mut recorder = self.device.recorder("probe");
        self.raster.backward(&mut recorder, &gaussians, camera, &d_image, &gradients)?;
        recorder.submit()?;
        let count = self.neural.counts()?[0] as usize;
        let rows = self.device.read_range(&gradients.geometry, 0, count)?;
        Ok(rows.iter().map(|row| row[3]).collect())
    }
}
