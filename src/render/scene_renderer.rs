//! Renders finished scenes from any camera into 8-bit images, depths and alphas.

use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use super::{
    DepthShader, DeviceAnchors, Gaussians, NeuralGaussians, RasterSettings, Rasterizer, RenderError,
    RenderViews,
    plain::{DeviceGaussians, PlainGaussians},
    views::{MIN_VISIBLE_ALPHA, ScalarImage, ScalarKind, Viewable},
};
use crate::{
    domain::{AnchorScene, Background, Camera, Digest, GaussianScene, Image, NearPlane, Problem, Scene},
    gpu::{AdapterChoice, Device, GpuError, Recorder},
    model::{AnchorRows, GaussianRows, NetworkLayout, Shape},
};

/// Incremented with every change that alters the bits of a view.
const VERSION: u32 = 1;

/// Scenes that a [`SceneViewer`] keeps on the device.
const SCENES_KEPT: usize = 4;

/// A scene on the device, ready to be rendered.
#[derive(Debug)]
pub struct SceneRenderer {
    device: Arc<Device>,
    source: SceneBuffers,
    raster: Rasterizer,
    depth: Option<DepthShader>,
    background: Background,
    near: NearPlane,
}

/// The parameters of the scene on the device.
#[derive(Debug)]
enum SceneBuffers {
    Anchors { anchors: DeviceAnchors, neural: Box<NeuralGaussians> },
    Gaussians { rows: DeviceGaussians, plain: Box<PlainGaussians> },
}

impl SceneBuffers {
    /// Records the Gaussians of the view from `camera`.
    fn forward(&mut self, recorder: &mut Recorder<'_>, camera: &Camera) -> Result<&Gaussians, RenderError> {
        match self {
            SceneBuffers::Anchors { anchors, neural } => {
                neural.forward(recorder, anchors, camera, 0.0)?;
                Ok(neural.gaussians())
            }
            SceneBuffers::Gaussians { rows, plain } => {
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
        device: &Arc<Device>,
        scene: &Scene,
        background: Background,
    ) -> Result<Self, RenderError> {
        match scene {
            Scene::Anchors(scene) => Self::new(device, scene, background),
            Scene::Gaussians(scene) => Self::of_gaussians(device, scene, background),
        }
    }

    /// Uploads a scene of anchors.
    ///
    /// # Errors
    /// As [`SceneRenderer::of_scene`].
    pub fn new(
        device: &Arc<Device>,
        scene: &AnchorScene,
        background: Background,
    ) -> Result<Self, RenderError> {
        let anchors = upload(device, scene)?;
        let (shape, near) = (anchors.shape, scene.near.depth());
        let neural = Box::new(NeuralGaussians::new(Arc::clone(device), shape, near, scene.unit)?);
        Self::of_source(device, SceneBuffers::Anchors { anchors, neural }, background, scene.near)
    }

    /// Uploads plain Gaussians.
    ///
    /// # Errors
    /// [`RenderError::Scene`] for a scene whose parts do not fit together; faults of the device.
    pub fn of_gaussians(
        device: &Arc<Device>,
        scene: &GaussianScene,
        background: Background,
    ) -> Result<Self, RenderError> {
        scene.check().map_err(|fault| RenderError::Scene(fault.to_string()))?;
        let mut plain = PlainGaussians::new(Arc::clone(device), scene.near.depth())?;
        plain.set_degree(u32::from(scene.degree))?;
        let rows = DeviceGaussians::upload(device, &GaussianRows::from_scene(scene))?;
        let source = SceneBuffers::Gaussians { rows, plain: Box::new(plain) };
        Self::of_source(device, source, background, scene.near)
    }

    fn of_source(
        device: &Arc<Device>,
        source: SceneBuffers,
        background: Background,
        near: NearPlane,
    ) -> Result<Self, RenderError> {
        let settings = RasterSettings { near: near.depth(), ..RasterSettings::default() };
        let raster = Rasterizer::new(Arc::clone(device), settings)?;
        Ok(Self { source, raster, depth: None, background, near, device: Arc::clone(device) })
    }

    /// Replaces the scene by another of the same shape, near plane and distance unit; rendering buffers are kept.
    ///
    /// # Errors
    /// [`RenderError::Scene`] for networks that this renderer does not know or another shape; faults of the device.
    pub fn replace(&mut self, scene: &AnchorScene) -> Result<(), RenderError> {
        let next = upload(&self.device, scene)?;
        match &mut self.source {
            SceneBuffers::Anchors { anchors, neural }
                if anchors.shape == next.shape && scene.near == self.near && scene.unit == neural.unit() =>
            {
                *anchors = next;
                Ok(())
            }
            SceneBuffers::Anchors { .. } | SceneBuffers::Gaussians { .. } => {
                let fault = "its widths, near plane or distance unit differ from those of the previous scene";
                Err(RenderError::Scene(fault.to_owned()))
            }
        }
    }

    /// The view from `camera`: RGB, rounded to 8 bits.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn render(&mut self, camera: &Camera) -> Result<Image, RenderError> {
        let samples = self
            .blend(camera, false)?
            .iter()
            .flat_map(|pixel| [pixel[0], pixel[1], pixel[2]])
            .map(|value| (value.clamp(0.0, 1.0) * 255.0).round() as u8)
            .collect();
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        Image::new(width, height, 3, samples).map_err(|fault| RenderError::Scene(fault.to_string()))
    }

    /// One number a pixel of the view from `camera`.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn plane(&mut self, camera: &Camera, kind: ScalarKind) -> Result<ScalarImage, RenderError> {
        let pixels = self.blend(camera, kind == ScalarKind::Depth)?;
        let value = |[first, _, _, transmittance]: &[f32; 4]| {
            let alpha = (1.0 - transmittance).clamp(0.0, 1.0);
            match kind {
                ScalarKind::Alpha => alpha,
                ScalarKind::Depth if alpha >= MIN_VISIBLE_ALPHA => first / alpha,
                ScalarKind::Depth => 0.0,
            }
        };
        let values = pixels.iter().map(value).collect();
        Ok(ScalarImage { width: camera.intrinsics.width, height: camera.intrinsics.height, values })
    }

    /// Blends the colours over the background, or the depths over nothing: three channels and the transmittance.
    fn blend(&mut self, camera: &Camera, depth: bool) -> Result<Vec<[f32; 4]>, RenderError> {
        let device = Arc::clone(&self.device);
        if depth && self.depth.is_none() {
            self.depth = Some(DepthShader::new(&device)?);
        }
        loop {
            let mut recorder = device.recorder("view");
            let gaussians = self.source.forward(&mut recorder, camera)?;
            match &mut self.depth {
                Some(shader) if depth => {
                    let deep = shader.forward(&device, &mut recorder, gaussians, camera)?;
                    self.raster.forward(&mut recorder, &deep, camera, [0.0; 3])?;
                }
                _ => self.raster.forward(&mut recorder, gaussians, camera, self.background.rgb())?,
            }
            recorder.submit()?;
            let counts = self.raster.counts()?;
            if !counts.overflowed {
                return Ok(device.read(self.raster.image())?);
            }
            self.raster.grow(&counts)?;
        }
    }
}

fn upload(device: &Device, scene: &AnchorScene) -> Result<DeviceAnchors, RenderError> {
    Shape::of(scene).check().map_err(RenderError::Scene)?;
    let rows = AnchorRows::from_scene(scene);
    let networks =
        NetworkLayout::new(rows.shape).from_networks(&scene.networks).map_err(RenderError::Scene)?;
    DeviceAnchors::upload(device, &rows, &networks)
}

/// Renders views of many scenes. Keeps the most recently used on the device, and reopens the device after it was lost or hung.
#[derive(Debug)]
pub struct SceneViewer {
    choice: AdapterChoice,
    identity: String,
    budget: u64,
    state: Mutex<ViewerState>,
}

#[derive(Debug)]
struct ViewerState {
    device: Arc<Device>,
    /// Latest used first.
    kept: Vec<(Digest, SceneRenderer)>,
}

impl SceneViewer {
    /// Opens the adapter of choice, without a limit on its buffers.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] or [`GpuError::Open`].
    pub fn open(choice: AdapterChoice) -> Result<Self, GpuError> {
        Self::within(choice, u64::MAX)
    }

    /// As [`SceneViewer::open`], with at most `budget` bytes of buffers. Least recently used scenes are evicted; a scene that
    /// exceeds the whole budget is refused as [`GpuError::OverBudget`].
    ///
    /// # Errors
    /// As [`SceneViewer::open`].
    pub fn within(choice: AdapterChoice, budget: u64) -> Result<Self, GpuError> {
        let state = ViewerState::open(&choice, budget)?;
        let identity = format!("{VERSION} on {}", state.device.adapter_line());
        Ok(Self { choice, identity, budget, state: Mutex::new(state) })
    }

    /// Adapter and driver in one line.
    #[must_use]
    pub fn adapter_line(&self) -> String {
        self.lock().device.adapter_line()
    }

    /// Peak bytes of buffers on the open device.
    #[must_use]
    pub fn peak_bytes(&self) -> u64 {
        self.lock().device.peak_bytes()
    }

    /// Destroys the device as a driver reset would, to test recovery.
    pub fn destroy_device(&self) {
        self.lock().device.destroy();
    }

    /// Makes the device count as hung, to test recovery.
    pub fn hang_device(&self) {
        self.lock().device.set_max_wait(Duration::ZERO);
    }

    fn lock(&self) -> MutexGuard<'_, ViewerState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn draw<T>(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        draw: RenderFn<'_, T>,
    ) -> Result<T, Problem> {
        let mut state = self.lock();
        if state.device.check().is_err() {
            *state = ViewerState::open(&self.choice, self.budget)?;
        }
        match state.draw(artifact, load, draw) {
            // A loss may show only in the commands that it makes fail, and those can be repeated. Commands that hung the device
            // would hang it again while others wait, so only the next view reopens it.
            Err(fault)
                if matches!(state.device.check(), Err(GpuError::DeviceLost(_) | GpuError::Rejected(_))) =>
            {
                tracing::warn!("reopening the device: {fault}");
                *state = ViewerState::open(&self.choice, self.budget)?;
                state.draw(artifact, load, draw)
            }
            outcome => outcome,
        }
    }
}

impl RenderViews for SceneViewer {
    fn identity(&self) -> String {
        self.identity.clone()
    }

    fn render(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Image, Problem> {
        self.draw(artifact, load, &|renderer| renderer.render(camera))
    }

    fn render_scalars(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
        kind: ScalarKind,
    ) -> Result<ScalarImage, Problem> {
        self.draw(artifact, load, &|renderer| renderer.plane(camera, kind))
    }
}

/// A view rendered with a scene's renderer.
type RenderFn<'a, T> = &'a dyn Fn(&mut SceneRenderer) -> Result<T, RenderError>;

impl ViewerState {
    fn open(choice: &AdapterChoice, budget: u64) -> Result<Self, GpuError> {
        let device = Device::new(choice)?;
        device.set_budget_bytes(budget);
        Ok(Self { device, kept: Vec::new() })
    }

    fn draw<T>(
        &mut self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        draw: RenderFn<'_, T>,
    ) -> Result<T, Problem> {
        let found = self.kept.iter().position(|(digest, _)| *digest == artifact);
        let mut renderer = found.map(|index| self.kept.remove(index).1);
        let mut loaded = None;
        loop {
            let outcome = match &mut renderer {
                Some(renderer) => draw(renderer),
                None => {
                    let viewable = match loaded.take() {
                        Some(viewable) => viewable,
                        None => load()?,
                    };
                    let made = SceneRenderer::of_scene(&self.device, &viewable.scene, viewable.background);
                    loaded = Some(viewable);
                    made.and_then(|made| draw(renderer.insert(made)))
                }
            };
            match outcome {
                Ok(drawn) => {
                    self.kept.splice(0..0, renderer.map(|renderer| (artifact, renderer)));
                    self.kept.truncate(SCENES_KEPT);
                    return Ok(drawn);
                }
                // Evict the least recently used scene first, then the grown buffers of this one.
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
