//! Depth on the device: Gaussians whose color is their depth, blended by the rasterizer like any color.
//!
//! So depth uses exactly the Gaussians and weights of the color image.

use std::sync::Arc;

use super::{Gaussians, Result, projection::CenteredPose};
use crate::{
    domain::Camera,
    gpu::{Binding, Buffer, Device, Kernel, Recorder, kernel_source},
};

/// `Depths` of `shaders/picture/shade_depth.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct DepthUniform {
    forward: [f32; 4],
    eye: [f32; 4],
    count: u32,
    unused: [u32; 3],
}

/// Replaces the colors of a view's Gaussians by their depths.
#[derive(Debug)]
pub struct DepthShader {
    kernel: Arc<Kernel>,
    colors: Buffer<[f32; 4]>,
}

impl DepthShader {
    /// Prepares the kernel; the buffer comes with the first view.
    pub fn new(device: &Device) -> Result<Self> {
        Ok(Self {
            kernel: device.kernel(kernel_source!("shade_depth"), &[])?,
            colors: device.buffer("depths as colors", 0)?,
        })
    }

    /// Records `gaussians` with their depth as red: the coordinate of their center along the camera's axis. Green and blue are
    /// 0.
    pub fn forward(
        &mut self,
        device: &Device,
        recorder: &mut Recorder<'_>,
        gaussians: &Gaussians,
        camera: &Camera,
    ) -> Result<Gaussians> {
        if self.colors.len() != gaussians.capacity {
            self.colors = device.buffer("depths as colors", gaussians.capacity)?;
        }
        let pose = CenteredPose::of(camera).relative_to(gaussians.origin);
        let count = u32::try_from(gaussians.capacity).unwrap_or(u32::MAX);
        let uniform = DepthUniform { forward: pose.rows[2], eye: pose.eye_and(0.0), count, unused: [0; 3] };
        let uniform = recorder.uniform(&[uniform])?;
        let buffers: [Binding<'_>; 3] = [&uniform, &gaussians.geometry, &self.colors];
        recorder.dispatch(&self.kernel, &buffers, count.div_ceil(64));
        Ok(Gaussians { colors: self.colors.clone(), ..gaussians.clone() })
    }
}
