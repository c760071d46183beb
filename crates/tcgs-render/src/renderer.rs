//! Renders finished scenes from any camera into 8-bit images, depths and alphas. Cameras and depths are in the world.

use std::{iter::Fuse, sync::Arc};

use super::{
    DepthShader, DeviceAnchors, Gaussians, NeuralGaussians, PackedImage, RasterSettings, Rasterizer,
    RenderError, Result,
    packed_image::PendingImage,
    plain::{DeviceGaussians, PlainGaussians},
    views::{MIN_VISIBLE_ALPHA, ScalarImage, ScalarKind},
};
use crate::{
    domain::{AnchorScene, Background, Camera, GaussianScene, Image, NearPlane, Scene, SceneFrame},
    gpu::{Device, Recorder},
    model::{AnchorRows, GaussianRows, ModelShape, NetworkLayout},
};

#[cfg(target_arch = "wasm32")]
mod page;

#[cfg(target_arch = "wasm32")]
pub use page::PageRenderer;

/// A scene on the device, ready to be rendered.
#[derive(Debug)]
pub struct Renderer {
    device: Arc<Device>,
    source: SceneBuffers,
    raster: Rasterizer,
    packed: Option<PackedImage>,
    depth: Option<DepthShader>,
    background: Background,
    near: NearPlane,
    frame: SceneFrame,
}

/// The parameters of the scene on the device.
#[derive(Debug)]
enum SceneBuffers {
    Anchors { anchors: DeviceAnchors, neural: Box<NeuralGaussians> },
    Gaussians { rows: DeviceGaussians, plain: Box<PlainGaussians> },
}

impl SceneBuffers {
    /// Records the Gaussians of the view from `camera`.
    fn forward(&mut self, recorder: &mut Recorder<'_>, camera: &Camera) -> Result<&Gaussians> {
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

impl Renderer {
    /// Uploads a scene of either kind.
    ///
    /// # Errors
    /// [`RenderError::Scene`] for widths or networks that this renderer does not know; faults of the device.
    pub fn of_scene(device: &Arc<Device>, scene: &Scene, background: Background) -> Result<Self> {
        match scene {
            Scene::Anchors(scene) => Self::new(device, scene, background),
            Scene::Gaussians(scene) => Self::of_gaussians(device, scene, background),
        }
    }

    /// Uploads a scene of anchors.
    ///
    /// # Errors
    /// As [`Renderer::of_scene`].
    pub fn new(device: &Arc<Device>, scene: &AnchorScene, background: Background) -> Result<Self> {
        let anchors = upload(device, scene)?;
        let (shape, near) = (anchors.shape, scene.near.depth());
        let neural = Box::new(NeuralGaussians::new(Arc::clone(device), shape, near, scene.scene_scale)?);
        let place = (scene.near, scene.frame);
        Self::of_source(device, SceneBuffers::Anchors { anchors, neural }, background, place)
    }

    /// Uploads plain Gaussians.
    ///
    /// # Errors
    /// [`RenderError::Scene`] for a scene whose parts do not fit together; faults of the device.
    pub fn of_gaussians(device: &Arc<Device>, scene: &GaussianScene, background: Background) -> Result<Self> {
        scene.check().map_err(|error| RenderError::Scene(error.to_string()))?;
        let mut plain = PlainGaussians::new(Arc::clone(device), scene.near.depth())?;
        plain.set_degree(u32::from(scene.degree))?;
        let rows = DeviceGaussians::upload(device, &GaussianRows::from_scene(scene))?;
        let source = SceneBuffers::Gaussians { rows, plain: Box::new(plain) };
        Self::of_source(device, source, background, (scene.near, scene.frame))
    }

    fn of_source(
        device: &Arc<Device>,
        source: SceneBuffers,
        background: Background,
        (near, frame): (NearPlane, SceneFrame),
    ) -> Result<Self> {
        let settings = RasterSettings { near: near.depth(), ..RasterSettings::default() };
        let raster = Rasterizer::new(Arc::clone(device), settings)?;
        let device = Arc::clone(device);
        Ok(Self { source, raster, packed: None, depth: None, background, near, frame, device })
    }

    /// Replaces the scene by another of the same shape, frame, near plane and scene scale; rendering buffers are kept.
    ///
    /// # Errors
    /// [`RenderError::Scene`] for networks that this renderer does not know or another shape; faults of the device.
    pub fn replace(&mut self, scene: &AnchorScene) -> Result<()> {
        let next = upload(&self.device, scene)?;
        match &mut self.source {
            SceneBuffers::Anchors { anchors, neural }
                if anchors.shape == next.shape
                    && scene.near == self.near
                    && scene.frame == self.frame
                    && scene.scene_scale == neural.scene_scale() =>
            {
                *anchors = next;
                Ok(())
            }
            SceneBuffers::Anchors { .. } | SceneBuffers::Gaussians { .. } => {
                let error =
                    "its widths, frame, near plane or scene scale differ from those of the previous scene";
                Err(RenderError::Scene(error.to_owned()))
            }
        }
    }

    /// The view from `camera`: RGB, rounded to 8 bits.
    pub fn render(&mut self, camera: &Camera) -> Result<Image> {
        let view = self.start(*camera)?;
        self.finish(view)
    }

    /// The views from cameras, each as [`Renderer::render`] gives it. While one is read back, the next renders.
    pub fn views<I: Iterator<Item = Camera>>(&mut self, cameras: I) -> Views<'_, I> {
        Views { renderer: self, cameras: cameras.fuse(), pending: None }
    }

    /// Submits a view, rounded to 8 bits, and returns where it will be.
    fn submit_packed(&mut self, camera: &Camera) -> Result<&mut PackedImage> {
        let device = Arc::clone(&self.device);
        let packed = match &mut self.packed {
            Some(packed) => packed,
            none => none.insert(PackedImage::new(&device)?),
        };
        let mut recorder = device.recorder("view");
        let inside = self.frame.camera_from_world(camera);
        let gaussians = self.source.forward(&mut recorder, &inside)?;
        self.raster.forward(&mut recorder, gaussians, &inside, self.background.rgb())?;
        packed.record(&device, &mut recorder, self.raster.image(), self.raster.counters())?;
        recorder.submit()?;
        Ok(packed)
    }

    /// Submits a view and the reading of it.
    fn start(&mut self, camera: Camera) -> Result<PendingView> {
        let device = Arc::clone(&self.device);
        let image = self.submit_packed(&camera)?.start_read(&device)?;
        Ok(PendingView { camera, image, capacity: self.raster.capacity() })
    }

    /// Waits for a view. One without room for its intersections renders again with more.
    fn finish(&mut self, mut view: PendingView) -> Result<Image> {
        let device = Arc::clone(&self.device);
        let samples = loop {
            let no_view = || RenderError::Scene("a view was not started".to_owned());
            let packed = self.packed.as_mut().ok_or_else(no_view)?;
            let (samples, counters) = packed.finish_read(&device, view.image)?;
            if !self.grow_for(&counters, view.capacity)? {
                break samples;
            }
            view = self.start(view.camera)?;
        };
        let (width, height) = (view.camera.intrinsics.width, view.camera.intrinsics.height);
        Image::new(width, height, 3, samples).map_err(|error| RenderError::Scene(error.to_string()))
    }

    /// Whether a view with room for `capacity` intersections lacks some, by its counters: then there is more room from now on.
    fn grow_for(&mut self, counters: &[u32], capacity: usize) -> Result<bool> {
        let counts = Rasterizer::counts_of(counters, capacity);
        if counts.overflowed && counts.intersections as usize > self.raster.capacity() {
            self.raster.grow(&counts)?;
        }
        Ok(counts.overflowed)
    }

    /// Renders the view from `camera` once more and leaves it on the device; the scene must have been rendered from there before.
    pub fn submit(&mut self, camera: &Camera) -> Result<()> {
        let device = Arc::clone(&self.device);
        let mut recorder = device.recorder("view");
        let inside = self.frame.camera_from_world(camera);
        let gaussians = self.source.forward(&mut recorder, &inside)?;
        self.raster.forward(&mut recorder, gaussians, &inside, self.background.rgb())?;
        Ok(recorder.submit()?)
    }

    /// The colors of the view from `camera` as the kernels leave them, neither rounded nor bounded, and the transmittance left behind
    /// each pixel.
    pub fn colors(&mut self, camera: &Camera) -> Result<Vec<[f32; 4]>> {
        self.blend(camera, false)
    }

    /// One number a pixel of the view from `camera`.
    pub fn plane(&mut self, camera: &Camera, kind: ScalarKind) -> Result<ScalarImage> {
        let pixels = self.blend(camera, kind == ScalarKind::Depth)?;
        Ok(self.scalars(camera, kind, &pixels))
    }

    /// One number for each of the blended pixels of a view.
    fn scalars(&self, camera: &Camera, kind: ScalarKind, pixels: &[[f32; 4]]) -> ScalarImage {
        let scale = self.frame.scale() as f32;
        let value = |[first, _, _, transmittance]: &[f32; 4]| {
            let alpha = (1.0 - transmittance).clamp(0.0, 1.0);
            match kind {
                ScalarKind::Alpha => alpha,
                ScalarKind::Depth if alpha >= MIN_VISIBLE_ALPHA => scale * (first / alpha),
                ScalarKind::Depth => 0.0,
            }
        };
        let values = pixels.iter().map(value).collect();
        ScalarImage { width: camera.intrinsics.width, height: camera.intrinsics.height, values }
    }

    /// Blends the colors over the background, or the depths over nothing: three channels and the transmittance.
    fn blend(&mut self, camera: &Camera, depth: bool) -> Result<Vec<[f32; 4]>> {
        let device = Arc::clone(&self.device);
        let camera = &self.frame.camera_from_world(camera);
        if depth && self.depth.is_none() {
            self.depth = Some(DepthShader::new(&device)?);
        }
        self.raster.submit_with_room("view", |raster, recorder| {
            let gaussians = self.source.forward(recorder, camera)?;
            match &mut self.depth {
                Some(shader) if depth => {
                    let deep = shader.forward(&device, recorder, gaussians, camera)?;
                    raster.forward(recorder, &deep, camera, [0.0; 3])
                }
                _ => raster.forward(recorder, gaussians, camera, self.background.rgb()),
            }
        })?;
        Ok(device.read(self.raster.image())?)
    }
}

/// A view that was submitted.
#[derive(Debug)]
struct PendingView {
    camera: Camera,
    image: PendingImage,
    /// Intersections that it had room for.
    capacity: usize,
}

/// The iterator of [`Renderer::views`]: at most two views are on the device.
#[derive(Debug)]
pub struct Views<'a, I> {
    renderer: &'a mut Renderer,
    cameras: Fuse<I>,
    pending: Option<PendingView>,
}

impl<I: Iterator<Item = Camera>> Iterator for Views<'_, I> {
    type Item = Result<Image>;

    fn next(&mut self) -> Option<Result<Image>> {
        let view = match self.pending.take() {
            Some(view) => Ok(view),
            None => self.renderer.start(self.cameras.next()?),
        };
        Some(view.and_then(|view| {
            self.pending = self.cameras.next().map(|camera| self.renderer.start(camera)).transpose()?;
            self.renderer.finish(view)
        }))
    }
}

fn upload(device: &Device, scene: &AnchorScene) -> Result<DeviceAnchors> {
    ModelShape::of(scene).check().map_err(RenderError::Scene)?;
    let rows = AnchorRows::from_scene(scene);
    let networks =
        NetworkLayout::new(rows.shape).from_networks(&scene.networks).map_err(RenderError::Scene)?;
    DeviceAnchors::upload(device, &rows, &networks)
}
