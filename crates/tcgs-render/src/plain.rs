//! Plain Gaussians on the device: from parameters and a camera to the Gaussians of a view, and their gradients back.
//!
//! Every Gaussian owns its rows and nothing is added concurrently, so the same input gives the same bits. Bands of spherical
//! harmonics above the degree in use are neither read nor written.

use std::sync::Arc;

use bytemuck::Zeroable;

use super::{GaussianGradients, Gaussians, RenderError, Result, projection::CenteredPose};
use crate::{
    domain::Camera,
    gpu::{AdapterReport, Buffer, Device, Kernel, Plan, Recorder, kernel_source, planned},
    model::{
        GaussianRows,
        gaussian_rows::{BANDS, BASE, band_values},
    },
};

/// Highest degree of spherical harmonics.
const MAX_DEGREE: u32 = 3;

/// Values of a Gaussian's row of growth statistics: sum of screen-gradient norms, views, largest radius in pixels.
pub const STATISTICS: usize = 3;

/// `View` of `shaders/shared/plain.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ViewUniform {
    rows: [[f32; 4]; 3],
    eye: [f32; 4],
    half_size: [f32; 2],
    count: u32,
    unused: u32,
}

/// Rows of plain Gaussians on the device: parameters, gradients or moments.
#[derive(Debug, Clone)]
pub struct DeviceGaussians {
    /// Gaussians.
    pub count: usize,
    /// `[N][14]` base values.
    pub base: Buffer<f32>,
    /// The blocks `[N][9]`, `[N][15]` and `[N][21]` of coefficients, one after the other.
    pub bands: Buffer<f32>,
}

impl DeviceGaussians {
    /// Plans zeros for `count` Gaussians.
    #[must_use]
    pub fn plan(count: usize) -> Plan<'static, Self> {
        planned!(Self {
            count: Plan::value(count),
            base: Plan::buffer("base values", count * BASE),
            bands: Plan::buffer("bands of coefficients", count * band_values(BANDS.len())),
        })
    }

    /// Uploads rows from the host.
    ///
    /// # Errors
    /// Faults of the device, or more Gaussians than it has memory for.
    pub fn upload(device: &Device, rows: &GaussianRows) -> Result<Self> {
        let made = Self::plan(rows.len()).make(device)?;
        device.write(&made.base, &rows.base);
        device.write(&made.bands, &rows.bands.concat());
        Ok(made)
    }

    /// Rows to the host. Waits for the device.
    pub fn download(&self, device: &Device) -> Result<GaussianRows> {
        let base = device.read(&self.base)?;
        let bands = device.read(&self.bands)?;
        let ends = [0, 1, 2, 3].map(|degree| self.count * band_values(degree));
        Ok(GaussianRows { base, bands: [0, 1, 2].map(|band| bands[ends[band]..ends[band + 1]].to_vec()) })
    }
}

/// The kernels for one degree.
#[derive(Debug)]
struct Kernels {
    shade_gaussians: Arc<Kernel>,
    shade_gradient: Arc<Kernel>,
}

impl Kernels {
    fn new(device: &Device, degree: u32) -> Result<Self> {
        let defs = [("DEGREE", degree)];
        Ok(Self {
            shade_gaussians: device.kernel(kernel_source!("shade_gaussians"), &defs)?,
            shade_gradient: device.kernel(kernel_source!("shade_gradient"), &defs)?,
        })
    }
}

/// Turns the parameters of plain Gaussians into the Gaussians of a view.
#[derive(Debug)]
pub struct PlainGaussians {
    device: Arc<Device>,
    degree: u32,
    kernels: Kernels,
    gaussian_statistics: Arc<Kernel>,
    /// Of the last forward pass.
    view: ViewUniform,
    gaussians: Gaussians,
    gradients: Option<GaussianGradients>,
    near: f32,
}

fn statistics_kernel(device: &Device, defs: &[(&str, u32)]) -> Result<Arc<Kernel>> {
    Ok(device.kernel(kernel_source!("gaussian_statistics"), defs)?)
}

impl PlainGaussians {
    /// Prepares the kernels for degree 0.
    pub fn new(device: Arc<Device>, near: f32) -> Result<Self> {
        Ok(Self {
            degree: 0,
            kernels: Kernels::new(&device, 0)?,
            gaussian_statistics: statistics_kernel(&device, &[("DEGREE", 0)])?,
            view: ViewUniform::zeroed(),
            gaussians: Gaussians::plan(0, 1).make(&device)?,
            gradients: None,
            near,
            device,
        })
    }

    /// Most Gaussians whose largest buffer the adapter binds.
    #[must_use]
    pub fn max_gaussians(adapter: &AdapterReport) -> usize {
        let limit = adapter.max_binding_bytes.min(adapter.max_buffer_bytes);
        let bytes = (band_values(BANDS.len()) * size_of::<f32>()) as u64;
        usize::try_from(limit / bytes).unwrap_or(usize::MAX)
    }

    /// Bytes on the device of a view of `count` Gaussians and of its gradients.
    #[must_use]
    pub fn bytes(count: usize) -> u64 {
        Gaussians::plan(count, 1).bytes() + GaussianGradients::plan(count).bytes()
    }

    /// Degree of spherical harmonics in use.
    #[must_use]
    pub fn degree(&self) -> u32 {
        self.degree
    }

    /// Uses another degree, at most 3, from the next forward pass on.
    pub fn set_degree(&mut self, degree: u32) -> Result<()> {
        let degree = degree.min(MAX_DEGREE);
        if degree != self.degree {
            self.kernels = Kernels::new(&self.device, degree)?;
            self.degree = degree;
        }
        Ok(())
    }

    /// The Gaussians of the last forward pass.
    #[must_use]
    pub fn gaussians(&self) -> &Gaussians {
        &self.gaussians
    }

    /// Buffers for a loss's gradients by those Gaussians.
    ///
    /// # Errors
    /// Faults of the device on first use.
    pub fn gaussian_gradients(&mut self) -> Result<&GaussianGradients> {
        let fits = self.gradients.as_ref().is_some_and(|d| d.colors.len() == self.gaussians.capacity);
        if !fits {
            self.gradients = Some(GaussianGradients::plan(self.gaussians.capacity).make(&self.device)?);
        }
        self.gradients.as_ref().ok_or(RenderError::OutOfStep)
    }

    /// Records the Gaussians of the view from `camera`.
    ///
    /// # Errors
    /// Faults of the device, or a scene that is too large for it.
    pub fn forward(
        &mut self,
        recorder: &mut Recorder<'_>,
        rows: &DeviceGaussians,
        camera: &Camera,
    ) -> Result<()> {
        if self.gaussians.capacity != rows.count {
            self.gaussians = Gaussians::plan(rows.count, 1).make(&self.device)?;
            self.device.write(&self.gaussians.count, &[rows.count as u32]);
        }
        self.view = self.view_uniform(rows.count, camera);
        let view = recorder.uniform(&[self.view])?;
        let out = &self.gaussians;
        recorder.dispatch(
            &self.kernels.shade_gaussians,
            &[&view, &rows.base, &rows.bands, &out.geometry, &out.colors],
            groups(rows.count),
        );
        Ok(())
    }

    /// Records the gradients by the rows from those by the Gaussians of the last forward pass.
    ///
    /// # Errors
    /// [`RenderError::OutOfStep`] before [`PlainGaussians::gaussian_gradients`].
    pub fn backward(
        &self,
        recorder: &mut Recorder<'_>,
        rows: &DeviceGaussians,
        out: &DeviceGaussians,
    ) -> Result<()> {
        let d = self.gradients.as_ref().ok_or(RenderError::OutOfStep)?;
        let on = &self.gaussians;
        let view = recorder.uniform(&[self.view])?;
        recorder.dispatch(
            &self.kernels.shade_gradient,
            &[
                &view,
                &rows.bands,
                &on.geometry,
                &on.colors,
                &d.geometry,
                &d.colors,
                &d.means2d,
                &out.base,
                &out.bands,
            ],
            groups(rows.count),
        );
        Ok(())
    }

    /// From now on, a view that gives a Gaussian no gradient is not among those that the statistics count for it: masks hide all that
    /// the view shows of it.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn count_views_with_gradient(&mut self) -> Result<()> {
        let defs = [("DEGREE", 0), ("MASKED", 1)];
        self.gaussian_statistics = statistics_kernel(&self.device, &defs)?;
        Ok(())
    }

    /// Records adding the view to the growth statistics, `[N][3]`; does nothing if `overflow_flag` is set when it runs.
    ///
    /// # Errors
    /// [`RenderError::OutOfStep`] before a backward pass.
    pub fn statistics(
        &self,
        recorder: &mut Recorder<'_>,
        statistics: &Buffer<f32>,
        overflow_flag: &Buffer<u32>,
    ) -> Result<()> {
        let d = self.gradients.as_ref().ok_or(RenderError::OutOfStep)?;
        let view = recorder.uniform(&[self.view])?;
        recorder.dispatch(
            &self.gaussian_statistics,
            &[&view, &d.means2d, statistics, overflow_flag],
            groups(self.gaussians.capacity),
        );
        Ok(())
    }

    fn view_uniform(&self, count: usize, camera: &Camera) -> ViewUniform {
        let pose = CenteredPose::of(camera);
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        ViewUniform {
            rows: pose.rows,
            eye: pose.eye_and(self.near),
            half_size: size.map(|side| 0.5 * side as f32),
            count: count as u32,
            unused: 0,
        }
    }
}

fn groups(count: usize) -> u32 {
    count.div_ceil(64) as u32
}
