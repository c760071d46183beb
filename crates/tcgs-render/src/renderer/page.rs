//! Views on the canvas of a web page. Nothing blocks: the page's one thread awaits what the device has done.

use std::sync::Arc;

use super::{PendingView, Renderer};
use crate::{
    DepthShader, RenderError, Result,
    domain::{Background, Camera, Image, Scene},
    gpu::{Buffer, Device, OffscreenCanvas, PageCanvas, Staging},
    views::{ScalarImage, ScalarKind},
};

/// A scene and the canvas that shows it.
#[derive(Debug)]
pub struct PageRenderer {
    device: Arc<Device>,
    renderer: Renderer,
    canvas: PageCanvas,
    counters: Staging,
}

impl PageRenderer {
    /// Opens the browser's device for `canvas` and uploads a scene.
    ///
    /// # Errors
    /// As [`Renderer::of_scene`], and [`GpuError::Open`](crate::gpu::GpuError::Open) in a browser without WebGPU.
    pub async fn open(canvas: OffscreenCanvas, scene: &Scene, background: Background) -> Result<Self> {
        let (device, canvas) = Device::of_page(canvas).await?;
        let renderer = Renderer::of_scene(&device, scene, background)?;
        Ok(Self { device, renderer, canvas, counters: Staging::default() })
    }

    /// Shows the view from `camera` on the canvas, which takes the size of the image.
    ///
    /// # Errors
    /// Faults of the device.
    pub async fn draw(&mut self, camera: &Camera) -> Result<()> {
        let [width, height] = [camera.intrinsics.width, camera.intrinsics.height];
        // Columns beyond the canvas, so that rows lie as a copy to a texture requires.
        let mut padded = *camera;
        padded.intrinsics.width = PageCanvas::padded(width);
        loop {
            let capacity = self.renderer.raster.capacity();
            let pixels = (padded.intrinsics.width * height) as usize;
            let words = self.renderer.submit_packed(&padded)?.words().clone();
            let counters = read(&self.device, &mut self.counters, &words, pixels).await?;
            if !self.renderer.grow_for(&counters, capacity)? {
                return Ok(self.canvas.show(&self.device, &words, [width, height])?);
            }
        }
    }

    /// The view from `camera`, as [`Renderer::render`] gives it.
    ///
    /// # Errors
    /// Faults of the device.
    pub async fn render(&mut self, camera: &Camera) -> Result<Image> {
        loop {
            let PendingView { camera, image, capacity } = self.renderer.start(*camera)?;
            image.read.mapped().await;
            let no_view = || RenderError::Scene("a view was not started".to_owned());
            let packed = self.renderer.packed.as_mut().ok_or_else(no_view)?;
            let (samples, counters) = packed.finish_read(&self.device, image)?;
            if !self.renderer.grow_for(&counters, capacity)? {
                let size = camera.intrinsics;
                return Image::new(size.width, size.height, 3, samples)
                    .map_err(|error| RenderError::Scene(error.to_string()));
            }
        }
    }

    /// The depths of the view from `camera`, as [`Renderer::plane`] gives them.
    ///
    /// # Errors
    /// Faults of the device.
    pub async fn depth(&mut self, camera: &Camera) -> Result<ScalarImage> {
        let Self { device, renderer, counters, .. } = self;
        let inside = renderer.frame.camera_from_world(camera);
        if renderer.depth.is_none() {
            renderer.depth = Some(DepthShader::new(device)?);
        }
        loop {
            let mut recorder = device.recorder("depths");
            let gaussians = renderer.source.forward(&mut recorder, &inside)?;
            if let Some(shader) = &mut renderer.depth {
                let deep = shader.forward(device, &mut recorder, gaussians, &inside)?;
                renderer.raster.forward(&mut recorder, &deep, &inside, [0.0; 3])?;
            }
            recorder.submit()?;
            let capacity = renderer.raster.capacity();
            let counts = read(device, counters, renderer.raster.counters(), 0).await?;
            if !renderer.grow_for(&counts, capacity)? {
                let pixels = read(device, &mut Staging::default(), renderer.raster.image(), 0).await?;
                return Ok(renderer.scalars(camera, ScalarKind::Depth, &pixels));
            }
        }
    }
}

/// The elements of `buffer` from `start` on.
async fn read<T: bytemuck::Pod>(
    device: &Device,
    staging: &mut Staging,
    buffer: &Buffer<T>,
    start: usize,
) -> Result<Vec<T>> {
    let pending = staging.start(device, buffer, start..buffer.len())?;
    pending.mapped().await;
    Ok(staging.finish(device, pending, <[T]>::to_vec)?)
}
