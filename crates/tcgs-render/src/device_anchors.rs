//! Anchors and their gradients on the device.

use super::Result;
use crate::{
    gpu::{Buffer, Device, Plan, planned},
    model::{AnchorRows, ModelShape, NetworkLayout},
};

/// Anchors on the device.
#[derive(Debug)]
pub struct DeviceAnchors {
    /// Widths.
    pub shape: ModelShape,
    /// Anchors in use.
    pub count: usize,
    /// World positions.
    pub positions: Buffer<[f32; 4]>,
    /// `[N][row]` parameters.
    pub rows: Buffer<f32>,
    /// Bit k set: offset k may make a Gaussian.
    pub masks: Buffer<u32>,
    /// The networks' flat parameters.
    pub networks: Buffer<f32>,
}

impl DeviceAnchors {
    /// Plans zeros for `anchors` anchors and their networks.
    #[must_use]
    pub fn plan(shape: ModelShape, anchors: usize) -> Plan<'static, Self> {
        Self::plan_with(shape, anchors, NetworkLayout::new(shape).parameters)
    }

    fn plan_with(shape: ModelShape, anchors: usize, parameters: usize) -> Plan<'static, Self> {
        planned!(Self {
            shape: Plan::value(shape),
            count: Plan::value(anchors),
            positions: Plan::buffer("anchor positions", anchors),
            rows: Plan::buffer("anchor rows", anchors * shape.row()),
            masks: Plan::buffer("offset masks", anchors),
            networks: Plan::buffer("networks", parameters),
        })
    }

    /// Uploads anchors and networks.
    ///
    /// # Errors
    /// Faults of the device, or a scene that is too large for it.
    pub fn upload(device: &Device, anchors: &AnchorRows, networks: &[f32]) -> Result<Self> {
        let made = Self::plan_with(anchors.shape, anchors.len(), networks.len()).make(device)?;
        device.write(&made.positions, &anchors.positions());
        device.write(&made.rows, &anchors.values);
        device.write(&made.masks, &anchors.masks);
        device.write(&made.networks, networks);
        Ok(made)
    }
}

/// Gradients by the anchors' rows and the networks' parameters.
#[derive(Debug)]
pub struct AnchorGradients {
    /// Laid out as [`DeviceAnchors::rows`]; zero for anchors that the view does not show.
    pub rows: Buffer<f32>,
    /// Laid out as [`DeviceAnchors::networks`].
    pub networks: Buffer<f32>,
}

impl AnchorGradients {
    /// Plans the gradients of `anchors` anchors.
    #[must_use]
    pub fn plan(shape: ModelShape, anchors: usize) -> Plan<'static, Self> {
        planned!(Self {
            rows: Plan::buffer("gradients of rows", anchors * shape.row()),
            networks: Plan::buffer("gradients of networks", NetworkLayout::new(shape).parameters),
        })
    }
}
