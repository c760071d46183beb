//! Renders finished scenes from any camera into 8-bit images.

use std::sync::{Arc, Mutex, PoisonError};

use super::{
    DeviceAnchors, NeuralGaussians, RasterSettings, Rasterizer, RenderError, RenderViews, views::Viewable,
};
use crate::{
    domain::{AnchorScene, Background, Camera, Digest, Image, Problem},
    gpu::Context,
    model::{AnchorRows, NetworkLayout},
};

/// Scenes that a [`SceneViewer`] keeps on the device.
const SCENES_KEPT: usize = 4;

/// A scene on the device, ready to be rendered.
#[derive(Debug)]
pub struct SceneRenderer {
    context: Arc<Context>,
    anchors: DeviceAnchors,
    neural: NeuralGaussians,
    raster: Rasterizer,
    background: Background,
}

impl SceneRenderer {
    /// Uploads a scene.
    ///
    /// # Errors
    /// [`RenderError::Scene`] for networks that this renderer does not know; faults of the device.
    pub fn new(
        context: &Arc<Context>,
        scene: &AnchorScene,
        background: Background,
    ) -> Result<Self, RenderError> {
        let rows = AnchorRows::from_scene(scene);
        let networks =
            NetworkLayout::new(rows.shape).from_networks(&scene.networks).map_err(RenderError::Scene)?;
        let settings = RasterSettings::default();
        Ok(Self {
            anchors: DeviceAnchors::upload(context, &rows, &networks)?,
            neural: NeuralGaussians::new(Arc::clone(context), rows.shape, settings.near)?,
            raster: Rasterizer::new(Arc::clone(context), settings)?,
            background,
            context: Arc::clone(context),
        })
    }

    /// The view from `camera`: RGB, rounded to 8 bits.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn render(&mut self, camera: &Camera) -> Result<Image, RenderError> {
        let context = Arc::clone(&self.context);
        loop {
            let mut recorder = context.recorder("view");
            self.neural.forward(&mut recorder, &self.anchors, camera, 0.0)?;
            self.raster.forward(&mut recorder, self.neural.gaussians(), camera, self.background.rgb())?;
            recorder.submit()?;
            let counts = self.raster.counts()?;
            if !counts.overflowed {
                break;
            }
            self.raster.grow(&counts)?;
        }
        let samples = context
            .read(self.raster.image())?
            .iter()
            .flat_map(|pixel| [pixel[0], pixel[1], pixel[2]])
            .map(|value| (value.clamp(0.0, 1.0) * 255.0).round() as u8)
            .collect();
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        Image::new(width, height, 3, samples).map_err(|fault| RenderError::Scene(fault.to_string()))
    }
}

/// Renders views of many scenes; keeps the latest used on the device.
#[derive(Debug)]
pub struct SceneViewer {
    context: Arc<Context>,
    kept: Mutex<Vec<(Digest, SceneRenderer)>>,
}

impl SceneViewer {
    /// A viewer on an open device.
    #[must_use]
    pub fn new(context: Arc<Context>) -> Self {
        Self { context, kept: Mutex::new(Vec::new()) }
    }
}

impl RenderViews for SceneViewer {
    fn render(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Image, Problem> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let found = kept.iter().position(|(digest, _)| *digest == artifact);
        let (digest, mut renderer) = match found {
            Some(index) => kept.remove(index),
            None => {
                let viewable = load()?;
                (artifact, SceneRenderer::new(&self.context, &viewable.scene, viewable.background)?)
            }
        };
        let image = renderer.render(camera)?;
        kept.insert(0, (digest, renderer));
        kept.truncate(SCENES_KEPT);
        Ok(image)
    }
}
