//! The device of a web page, with the canvas that it draws on.
//!
//! What always holds: nothing blocks, since a page has one thread; kernels use no subgroups, which would have to be verified first.

use std::{sync::Arc, time::Duration};

pub use wgpu::web_sys::OffscreenCanvas;

use super::{Buffer, Device, DeviceSettings, GpuError, adapter};

/// Pixels that a row of the drawn image is a multiple of, as copies from buffers to textures require.
const ROW_PIXELS: u32 = wgpu::COPY_BYTES_PER_ROW_ALIGNMENT / 4;

/// The colors of the canvas, as `pack_image` writes them.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;

/// A canvas that a device draws on.
#[derive(Debug)]
pub struct PageCanvas {
    surface: wgpu::Surface<'static>,
    size: [u32; 2],
}

impl Device {
    /// Opens the adapter that the browser prefers for `canvas`.
    ///
    /// # Errors
    /// [`GpuError::Open`].
    pub async fn of_page(canvas: OffscreenCanvas) -> Result<(Arc<Self>, PageCanvas), GpuError> {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends: wgpu::Backends::BROWSER_WEBGPU,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        let none = |error: String| GpuError::Open { adapter: "WebGPU".to_owned(), error };
        let surface = instance
            .create_surface(wgpu::SurfaceTarget::OffscreenCanvas(canvas))
            .map_err(|error| none(error.to_string()))?;
        let options = wgpu::RequestAdapterOptions {
            power_preference: wgpu::PowerPreference::HighPerformance,
            compatible_surface: Some(&surface),
            ..wgpu::RequestAdapterOptions::default()
        };
        let chosen = instance.request_adapter(&options).await.map_err(|error| none(error.to_string()))?;
        let report = DeviceSettings::default().apply(adapter::describe(&chosen));
        let device = Arc::new(Self::open(&chosen, report, Duration::MAX).await?);
        Ok((device, PageCanvas { surface, size: [0; 2] }))
    }
}

impl PageCanvas {
    /// Width of an image whose first `width` columns the canvas shows.
    #[must_use]
    pub fn padded(width: u32) -> u32 {
        width.next_multiple_of(ROW_PIXELS)
    }

    /// Shows the first `size[0]` columns of an image of packed colors whose rows have [`PageCanvas::padded`] pixels.
    ///
    /// # Errors
    /// [`GpuError::Rejected`] if the browser gives no texture; faults of the device.
    pub fn show(&mut self, device: &Device, image: &Buffer<u32>, size: [u32; 2]) -> Result<(), GpuError> {
        let [width, height] = size;
        if self.size != size {
            self.surface.configure(
                &device.inner,
                &wgpu::SurfaceConfiguration {
                    usage: wgpu::TextureUsages::COPY_DST,
                    format: FORMAT,
                    color_space: wgpu::SurfaceColorSpace::default(),
                    width,
                    height,
                    present_mode: wgpu::PresentMode::Fifo,
                    desired_maximum_frame_latency: 2,
                    alpha_mode: wgpu::CompositeAlphaMode::Opaque,
                    view_formats: Vec::new(),
                },
            );
            self.size = size;
        }
        let texture = match self.surface.get_current_texture() {
            wgpu::CurrentSurfaceTexture::Success(texture)
            | wgpu::CurrentSurfaceTexture::Suboptimal(texture) => texture,
            other => return Err(GpuError::Rejected(format!("the canvas gives no texture: {other:?}"))),
        };
        let rows = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(4 * Self::padded(width)),
            rows_per_image: None,
        };
        let mut encoder = device.inner.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_texture(
            wgpu::TexelCopyBufferInfo { buffer: image.raw(), layout: rows },
            texture.texture.as_image_copy(),
            wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
        );
        device.queue.submit([encoder.finish()]);
        device.queue.present(texture);
        device.check()
    }
}
