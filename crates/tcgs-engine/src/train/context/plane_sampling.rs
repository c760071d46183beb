//! Samples the planes at the anchors for the networks' input on the device, and gathers the gradient by the planes.

use std::sync::Arc;

use super::{anchor_tables::DeviceTables, convolution::Tensor};
use crate::{
    gpu::{Buffer, Device, GpuError, Kernel, Recorder, kernel_source},
    render::Columns,
};

/// The kernels.
#[derive(Debug)]
pub(super) struct Sampling {
    context_input: Arc<Kernel>,
    neighbor_gradient: Arc<Kernel>,
    plane_gradient: Arc<Kernel>,
}

impl Sampling {
    pub(super) fn new(device: &Device) -> Result<Self, GpuError> {
        Ok(Self {
            context_input: device.kernel(kernel_source!("context_input"), &[])?,
            neighbor_gradient: device.kernel(kernel_source!("neighbor_gradient"), &[])?,
            plane_gradient: device.kernel(kernel_source!("plane_gradient"), &[])?,
        })
    }

    /// Records the input of the sampled anchors.
    pub(super) fn forward(
        &self,
        recorder: &mut Recorder<'_>,
        tables: &DeviceTables,
        columns: Columns<'_>,
        planes: &Tensor,
        input: &Buffer<f32>,
    ) -> Result<(), GpuError> {
        let config = &tables.config;
        let sampled = config.kind.sampled();
        let uniform = recorder.uniform(&[
            [
                config.planes.edge as u32,
                config.planes.channels as u32,
                sampled as u32,
                columns.capacity as u32,
            ],
            [planes.first as u32, 0, 0, 0],
        ])?;
        recorder.dispatch(
            &self.context_input,
            &[
                &uniform,
                columns.list,
                &tables.neighbors,
                &tables.texels,
                &tables.priors,
                &planes.buffer,
                input,
            ],
            ((3 * sampled + 1) * columns.capacity.div_ceil(64)) as u32,
        );
        Ok(())
    }

    /// Records the gradient by the planes from that by the sampled anchors' input; `d_samples` has a row for each anchor.
    pub(super) fn backward(
        &self,
        recorder: &mut Recorder<'_>,
        tables: &DeviceTables,
        capacity: usize,
        d_input: &Buffer<f32>,
        d_samples: &Buffer<f32>,
        d_planes: &Tensor,
    ) -> Result<(), GpuError> {
        let planes = &tables.config.planes;
        let uniform =
            recorder.uniform(&[[tables.count as u32, 3 * planes.channels as u32, capacity as u32, 0]])?;
        recorder.dispatch(
            &self.neighbor_gradient,
            &[&uniform, &tables.user_starts, &tables.users, &tables.columns, d_input, d_samples],
            tables.count.div_ceil(64) as u32,
        );
        let fours = planes.channels / 4;
        let uniform = recorder.uniform(&[[planes.edge as u32, fours as u32, d_planes.first as u32, 0]])?;
        recorder.dispatch(
            &self.plane_gradient,
            &[&uniform, &tables.plane_starts, &tables.plane_users, d_samples, &d_planes.buffer],
            (3 * fours * planes.edge * planes.edge).div_ceil(64) as u32,
        );
        Ok(())
    }
}
