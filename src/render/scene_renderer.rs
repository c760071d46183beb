//! Renders finished scenes from any camera into 8-bit images.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::{
    DeviceAnchors, Gaussians, NeuralGaussians, RasterSettings, Rasterizer, RenderError, RenderViews,
    plain::{DeviceRows, PlainGaussians},
    views::Viewable,
};
use crate::{
    domain::{AnchorScene, Background, Camera, Digest, GaussianScene, Image, NearPlane, Problem, Scene},
    gpu::{AdapterChoice, Context, GpuError, Recorder},
    model::{AnchorRows, GaussianRows, NetworkLayout, Shape},
};

/// Scenes that a [`SceneViewer`] keeps on the device.
const SCENES_KEPT: usize = 4;

/// A scene on the device, ready to be rendered.
#[derive(Debug)]
pub struct SceneRenderer {
    context: Arc<Context>,
    source: Source,
    raster: Rasterizer,
    background: Background,
    near: NearPlane,
}

/// What a view's Gaussians are made from.
#[derive(Debug)]
enum Source {
    Anchors { anchors: DeviceAnchors, neural: Box<NeuralGaussians> },
    Gaussians { rows: DeviceRows, plain: Box<PlainGaussians> },
}

impl Source {
    /// Records the making of the Gaussians that `camera` sees.
    fn forward(&mut self, recorder: &mut Recorder<'_>, camera: &Camera) -> Result<&Gaussians, RenderError> {
        match self {
            Source::Anchors { anchors, neural } => {
                neural.forward(recorder, anchors, camera, 0.0)?;
                Ok(neural.gaussians())
            }
            Source::Gaussians { rows, plain } => {
                plain.forward(recorder, rows, camera)?;
                Ok(plain.gaussians())
            }
        }
    }
}

impl SceneRenderer {
    /// Uploads a scene of either kind.
    ///
    /// # Errors
    /// [`RenderError::Scene`] for widths or networks that this renderer does not know; faults of the device.
    pub fn of_scene(
        context: &Arc<Context>,
        scene: &Scene,
        background: Background,
    ) -> Result<Self, RenderError> {
        match scene {
            Scene::Anchors(scene) => Self::new(context, scene, background),
            Scene::Gaussians(scene) => Self::of_gaussians(context, scene, background),
        }
    }

    /// Uploads a scene of anchors.
    ///
    /// # Errors
    /// As [`SceneRenderer::of_scene`].
    pub fn new(
        context: &Arc<Context>,
        scene: &AnchorScene,
        background: Background,
    ) -> Result<Self, RenderError> {
        let anchors = upload(context, scene)?;
        let neural = Box::new(NeuralGaussians::new(Arc::clone(context), anchors.shape, scene.near.depth())?);
        Self::of_source(context, Source::Anchors { anchors, neural }, background, scene.near)
    }

    /// Uploads plain Gaussians.
    ///
    /// # Errors
    /// [`RenderError::Scene`] for a scene whose parts do not fit together; faults of the device.
    pub fn of_gaussians(
        context: &Arc<Context>,
        scene: &GaussianScene,
        background: Background,
    ) -> Result<Self, RenderError> {
        scene.check().map_err(|fault| RenderError::Scene(fault.to_string()))?;
        let mut plain = PlainGaussians::new(Arc::clone(context), scene.near.depth())?;
        plain.set_degree(u32::from(scene.degree))?;
        let rows = DeviceRows::upload(context, &GaussianRows::from_scene(scene))?;
        let source = Source::Gaussians { rows, plain: Box::new(plain) };
        Self::of_source(context, source, background, scene.near)
    }

    fn of_source(
        context: &Arc<Context>,
        source: Source,
        background: Background,
        near: NearPlane,
    ) -> Result<Self, RenderError> {
        let settings = RasterSettings { near: near.depth(), ..RasterSettings::default() };
        let raster = Rasterizer::new(Arc::clone(context), settings)?;
        Ok(Self { source, raster, background, near, context: Arc::clone(context) })
    }

    /// Shows another scene of the same shape and near plane from now on; the buffers of rendering are kept.
    ///
    /// # Errors
    /// [`RenderError::Scene`] for networks that this renderer does not know or another shape; faults of the device.
    pub fn replace(&mut self, scene: &AnchorScene) -> Result<(), RenderError> {
        let next = upload(&self.context, scene)?;
        match &mut self.source {
            Source::Anchors { anchors, .. } if anchors.shape == next.shape && scene.near == self.near => {
                *anchors = next;
                Ok(())
            }
            Source::Anchors { .. } | Source::Gaussians { .. } => {
                let fault = "its widths or its near plane are not those of the scene before it";
                Err(RenderError::Scene(fault.to_owned()))
            }
        }
    }

    /// The view from `camera`: RGB, rounded to 8 bits.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn render(&mut self, camera: &Camera) -> Result<Image, RenderError> {
        let context = Arc::clone(&self.context);
        loop {
            let mut recorder = context.recorder("view");
            let gaussians = self.source.forward(&mut recorder, camera)?;
            self.raster.forward(&mut recorder, gaussians, camera, self.background.rgb())?;
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

fn upload(context: &Context, scene: &AnchorScene) -> Result<DeviceAnchors, RenderError> {
    Shape::of(scene).check().map_err(RenderError::Scene)?;
    let rows = AnchorRows::from_scene(scene);
    let networks =
        NetworkLayout::new(rows.shape).from_networks(&scene.networks).map_err(RenderError::Scene)?;
    DeviceAnchors::upload(context, &rows, &networks)
}

/// Renders views of many scenes; keeps the latest used on the device, which is opened again after it was lost.
#[derive(Debug)]
pub struct SceneViewer {
    choice: AdapterChoice,
    budget: u64,
    state: Mutex<ViewerState>,
}

#[derive(Debug)]
struct ViewerState {
    context: Arc<Context>,
    /// Latest used first.
    kept: Vec<(Digest, SceneRenderer)>,
}

impl SceneViewer {
    /// Opens the adapter of choice, without a bound on what its buffers take.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] or [`GpuError::Open`].
    pub fn open(choice: AdapterChoice) -> Result<Self, GpuError> {
        Self::within(choice, u64::MAX)
    }

    /// As [`SceneViewer::open`]; buffers take at most `budget` bytes. Scenes used before make room for the one that is
    /// asked for, and one for which all of it is not enough is refused as [`GpuError::OverBudget`].
    ///
    /// # Errors
    /// As [`SceneViewer::open`].
    pub fn within(choice: AdapterChoice, budget: u64) -> Result<Self, GpuError> {
        let state = Mutex::new(ViewerState::open(&choice, budget)?);
        Ok(Self { choice, budget, state })
    }

    /// Adapter and driver in one line.
    #[must_use]
    pub fn adapter_line(&self) -> String {
        self.lock().context.adapter_line()
    }

    /// The most that buffers ever took on the device that is open, in bytes.
    #[must_use]
    pub fn peak_bytes(&self) -> u64 {
        self.lock().context.peak_bytes()
    }

    /// Loses the device, as a driver reset would; for tests of the recovery.
    pub fn destroy_device(&self) {
        self.lock().context.destroy();
    }

    fn lock(&self) -> MutexGuard<'_, ViewerState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl RenderViews for SceneViewer {
    fn render(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Image, Problem> {
        let mut state = self.lock();
        if state.context.check().is_err() {
            *state = ViewerState::open(&self.choice, self.budget)?;
        }
        match state.render(artifact, load, camera) {
            // A loss may become known only by the commands that fail for it, and those can be given again.
            Err(fault) if state.context.check().is_err() => {
                tracing::warn!("opening the device again: {fault}");
                *state = ViewerState::open(&self.choice, self.budget)?;
                state.render(artifact, load, camera)
            }
            outcome => outcome,
        }
    }
}

impl ViewerState {
    fn open(choice: &AdapterChoice, budget: u64) -> Result<Self, GpuError> {
        let context = Context::new(choice)?;
        context.set_budget_bytes(budget);
        Ok(Self { context, kept: Vec::new() })
    }

    fn render(
        &mut self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Image, Problem> {
        let found = self.kept.iter().position(|(digest, _)| *digest == artifact);
        let mut renderer = found.map(|index| self.kept.remove(index).1);
        let mut loaded = None;
        loop {
            let outcome = match &mut renderer {
                Some(renderer) => renderer.render(camera),
                None => {
                    let viewable = match loaded.take() {
                        Some(viewable) => viewable,
                        None => load()?,
                    };
                    let made = SceneRenderer::of_scene(&self.context, &viewable.scene, viewable.background);
                    loaded = Some(viewable);
                    made.and_then(|made| renderer.insert(made).render(camera))
                }
            };
            match outcome {
                Ok(image) => {
                    self.kept.splice(0..0, renderer.map(|renderer| (artifact, renderer)));
                    self.kept.truncate(SCENES_KEPT);
                    return Ok(image);
                }
                // What was used longest ago goes first, and then what a view before this one made the buffers grow to.
                Err(RenderError::Gpu(GpuError::OverBudget { .. }))
                    if self.kept.pop().is_some() || loaded.is_none() =>
                {
                    renderer = None;
                }
                Err(fault) => return Err(fault.into()),
            }
        }
    }
}
