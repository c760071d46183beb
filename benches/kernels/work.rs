//! The minimum work of each stage, independent of its kernels: the bytes that must be read and written, and the floating-point
//! operations of the equations.
//!
//! Bytes are those of the stage's own inputs and outputs, each touched once, four a number: repeated reads and data
//! passed between kernels of a stage do not count, and so lower their share. Operations are counted as if nothing
//! were skipped inside a tile: a rasterizer that skips what does not reach a pixel does less than it is credited with.

use tcgs::{
    model::NetworkLayout,
    render::{RasterCounts, TILE},
};

use crate::scene::SHAPE;

/// Bytes and floating-point operations.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Work {
    pub(crate) bytes: f64,
    pub(crate) flops: f64,
}

/// What a stage's work depends on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Size {
    pub(crate) gaussians: usize,
    pub(crate) anchors: usize,
    pub(crate) parameters: usize,
    pub(crate) side: u32,
    pub(crate) counts: RasterCounts,
}

impl Size {
    /// The work of the stage of that name; none if it is not known.
    pub(crate) fn work(&self, stage: &str) -> Work {
        let gaussians = self.gaussians as f64;
        let visible = f64::from(self.counts.visible);
        let slots = f64::from(self.counts.intersections);
        let pixels = f64::from(self.side).powi(2);
        let pairs = slots * f64::from(TILE * TILE);
        let anchors = self.anchors as f64;
        let layout = NetworkLayout::new(SHAPE);
        let layers = std::iter::once(&layout.hidden).chain(&layout.heads);
        let products: f64 = layers.map(|layer| (layer.inputs * layer.outputs) as f64).sum();
        // View direction and distance need no gradient.
        let unwanted = ((layout.hidden.inputs - SHAPE.features) * layout.hidden.outputs) as f64;
        let row = SHAPE.row() as f64;
        let spawned = 11.0 * SHAPE.offsets as f64;
        let (floats, flops) = match stage {
            // Place, size, rotation, color in; place, conic, color, depth, tiles out.
            "project" => (16.0 * gaussians + 14.0 * visible, 200.0 * gaussians + 30.0 * slots),
            // Depth and index of the visible; tile and slot of each intersection; each read and written once a pass of
            // eight bits, of which depth takes four and tiles one or two.
            "sort" => (4.0 * 4.0 * visible + 2.0 * 4.0 * slots, 0.0),
            // The splats of each tile's list once; the image and the last contributor. Power, falloff, blend.
            "forward" => (12.0 * slots + 5.0 * pixels, 20.0 * pairs),
            // Besides: the image's gradient, a slot's nine sums twice, and the gradients of each Gaussian.
            "backward" => (12.0 * slots + 9.0 * pixels + 18.0 * slots + 40.0 * gaussians, 60.0 * pairs),
            // Render, photograph and gradient; eleven taps twice for four moments and three derivatives a channel, and the
            // wavelet transform there and back.
            "loss" => (9.0 * pixels, 3.0 * pixels * (2.0 * 2.0 * 11.0 * 7.0 + 90.0)),
            "networks forward" => (anchors * (row + 4.0 + 1.6 * spawned), anchors * 2.0 * products),
            "networks backward" => {
                (anchors * (2.0 * row + 3.2 * spawned), anchors * 2.0 * (2.0 * products - unwanted))
            }
            "adam" => (7.0 * self.parameters as f64, 14.0 * self.parameters as f64),
            _ => (0.0, 0.0),
        };
        Work { bytes: 4.0 * floats, flops }
    }
}
