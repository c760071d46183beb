//! Memory of the models in training, by their size.

use std::fmt;

use super::{CompressionSchedule, Moments, OffsetMasks, Statistics, compression::compression_bytes};
use crate::{
    gpu::{AdapterReport, buffer_bytes},
    model::{ModelShape, NetworkLayout},
    render::{AnchorGradients, DeviceAnchors, DeviceGaussians, NeuralGaussians, PlainGaussians, STATISTICS},
};

/// Memory of a kind of model, by its size.
pub(super) trait Footprint: fmt::Debug {
    /// The unit of its size: "anchors".
    fn unit(&self) -> &'static str;
    /// The largest size that its schedule and the adapter's bindings allow.
    fn max_size(&self, adapter: &AdapterReport) -> usize;
    /// Bytes on the device of the parameters, their gradients, the optimizer and growth, at their largest.
    fn model_bytes(&self, size: usize) -> u64;
    /// Bytes on the device of making a view's Gaussians, and of the gradients back from them.
    fn view_bytes(&self, size: usize) -> u64;
    /// Rows of Gaussians that the rasterizer is handed.
    fn gaussians(&self, size: usize) -> usize;
    /// Bytes of main memory, at their largest.
    fn host_bytes(&self, size: usize) -> u64;
}

/// Host bytes an anchor of the context model's tables while they are made: neighbors, texels and both the other way round,
/// as lists and as they are sorted, and steps by cell.
const CONTEXT_HOST_BYTES: usize = 1024;

/// Memory of the anchor model.
#[derive(Debug)]
pub(super) struct AnchorFootprint {
    pub(super) shape: ModelShape,
    pub(super) max_anchors: usize,
    /// Whether it begins as plain Gaussians, at most as many.
    pub(super) two_stages: bool,
    /// Whether masks learn.
    pub(super) masks: bool,
    /// Compression-aware training; none in the baseline.
    pub(super) compression: Option<CompressionSchedule>,
}

impl Footprint for AnchorFootprint {
    fn unit(&self) -> &'static str {
        "anchors"
    }

    fn max_size(&self, adapter: &AdapterReport) -> usize {
        self.max_anchors.min(NeuralGaussians::max_anchors(adapter, self.shape))
    }

    /// Rows that a round of growth replaces go one after another, so the largest of them counts twice.
    fn model_bytes(&self, anchors: usize) -> u64 {
        let shape = self.shape;
        let (rows, parameters) = (anchors * shape.row(), NetworkLayout::new(shape).parameters);
        let own = DeviceAnchors::plan(shape, anchors).bytes()
            + AnchorGradients::plan(shape, anchors).bytes()
            + 2 * Moments::plan(rows).bytes()
            + Moments::plan(parameters).bytes()
            + Statistics::bytes(shape, anchors)
            + if self.masks { OffsetMasks::plan(shape, anchors).bytes() } else { 0 }
            + self.compression.as_ref().map_or(0, |schedule| compression_bytes(schedule, shape, anchors))
            + 2 * buffer_bytes::<f32>(shape.row() + parameters);
        own.max(self.first_stage().map_or(0, |gaussians| gaussians.model_bytes(anchors)))
    }

    fn view_bytes(&self, anchors: usize) -> u64 {
        let own = NeuralGaussians::bytes(self.shape, anchors);
        own.max(self.first_stage().map_or(0, |gaussians| gaussians.view_bytes(anchors)))
    }

    fn gaussians(&self, anchors: usize) -> usize {
        NeuralGaussians::capacity(anchors).saturating_mul(self.shape.offsets)
    }

    /// A round of growth: rows and moments with the copies that growing vectors make, statistics, and a candidate for each
    /// offset.
    fn host_bytes(&self, anchors: usize) -> u64 {
        let shape = self.shape;
        const CANDIDATE: usize = 2 * size_of::<(usize, [i32; 3], f32)>();
        const CELL: usize = 64;
        let masks = if self.masks { 3 * shape.offsets } else { 0 };
        let row = 6 * (shape.row() + masks) * size_of::<f32>();
        let own = 2 * Statistics::bytes(shape, anchors)
            + (anchors * (row + shape.offsets * CANDIDATE + CELL)) as u64
            + if self.compression.is_some() { (anchors * CONTEXT_HOST_BYTES) as u64 } else { 0 };
        own.max(self.first_stage().map_or(0, |gaussians| gaussians.host_bytes(anchors)))
    }
}

impl AnchorFootprint {
    fn first_stage(&self) -> Option<PlainFootprint> {
        self.two_stages.then_some(PlainFootprint { max_gaussians: self.max_anchors })
    }
}

/// Memory of plain Gaussians.
#[derive(Debug)]
pub(super) struct PlainFootprint {
    pub(super) max_gaussians: usize,
}

impl Footprint for PlainFootprint {
    fn unit(&self) -> &'static str {
        "Gaussians"
    }

    fn max_size(&self, adapter: &AdapterReport) -> usize {
        self.max_gaussians.min(PlainGaussians::max_gaussians(adapter))
    }

    /// Parameters, gradients and two moments; a round of growth replaces them one after another.
    fn model_bytes(&self, gaussians: usize) -> u64 {
        5 * DeviceGaussians::plan(gaussians).bytes() + 2 * buffer_bytes::<f32>(STATISTICS * gaussians)
    }

    fn view_bytes(&self, gaussians: usize) -> u64 {
        PlainGaussians::bytes(gaussians)
    }

    fn gaussians(&self, gaussians: usize) -> usize {
        gaussians
    }

    /// A round of growth: rows and moments as read back, as grown, and on their way to the device.
    fn host_bytes(&self, gaussians: usize) -> u64 {
        9 * DeviceGaussians::plan(gaussians).bytes() + (gaussians * STATISTICS * size_of::<f32>()) as u64
    }
}
