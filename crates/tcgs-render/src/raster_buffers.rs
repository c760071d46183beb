//! Buffers of the rasterizer: a row for each Gaussian, for each intersection with a tile, and for each pixel.

use super::projection::TILE;
use crate::gpu::{AdapterReport, Buffer, Pairs, Plan, RadixSort, Scan, ScanSlots, planned};

/// Elements of the counter buffer, as in `shaders/shared/view.wgsl`.
pub(super) const REQUIRED: usize = 0;
pub(super) const COMPLETED: usize = 1;
pub(super) const VISIBLE: u32 = 2;
pub(super) const INTERSECTIONS: u32 = 3;
const COUNTERS: usize = 4;

/// Bits of the depth keys. Depths are positive floats: their bits order as integers, and the sign bit is clear.
const DEPTH_BITS: u32 = 31;

/// Rows of four floats of a projected Gaussian: place, conic, color.
pub(super) const SPLAT_ROWS: usize = 3;

/// Floats of each slot of the backward pass: center 2, opacity, conic 3, color 3.
pub(super) const SLOT_FLOATS: usize = 9;

/// Buffers with a row for each Gaussian.
#[derive(Debug)]
pub(super) struct PerGaussian {
    pub(super) capacity: usize,
    pub(super) splats: Buffer<[f32; 4]>,
    pub(super) d_splats: Buffer<[f32; 4]>,
    pub(super) depths: Buffer<u32>,
    pub(super) tiles: Buffer<u32>,
    pub(super) visible: Buffer<u32>,
    pub(super) places: Buffer<u32>,
    pub(super) by_depth: (Pairs, Pairs),
    pub(super) sorted_tiles: Buffer<u32>,
    pub(super) starts: Buffer<u32>,
    pub(super) first_slots: Buffer<u32>,
    pub(super) list_visible: Scan,
    pub(super) sort_depth: RadixSort,
    pub(super) place_slots: Scan,
}

impl PerGaussian {
    pub(super) fn plan(adapter: &AdapterReport, capacity: usize) -> Plan<'static, Self> {
        let visible = ScanSlots { count: 0, total: VISIBLE };
        let slots = ScanSlots { count: VISIBLE, total: INTERSECTIONS };
        planned!(Self {
            capacity: Plan::value(capacity),
            splats: Plan::buffer("splats", SPLAT_ROWS * capacity),
            d_splats: Plan::buffer("gradients of splats", SPLAT_ROWS * capacity),
            depths: Plan::buffer("depths", capacity),
            tiles: Plan::buffer("tiles touched", capacity),
            visible: Plan::buffer("visible", capacity),
            places: Plan::buffer("places among the visible", capacity),
            by_depth: Pairs::plan(capacity).and(Pairs::plan(capacity)),
            sorted_tiles: Plan::buffer("tiles touched by depth", capacity),
            starts: Plan::buffer("slot starts by depth", capacity),
            first_slots: Plan::buffer("first slots", capacity),
            list_visible: Scan::plan(adapter, capacity, visible),
            sort_depth: RadixSort::plan(adapter, capacity, DEPTH_BITS, VISIBLE),
            place_slots: Scan::plan(adapter, capacity, slots),
        })
    }
}

/// Buffers with a row for each intersection of a Gaussian with a tile.
#[derive(Debug)]
pub(super) struct PerIntersection {
    pub(super) capacity: usize,
    pub(super) by_tile: (Pairs, Pairs),
    pub(super) slot_ids: Buffer<u32>,
    pub(super) list: Buffer<u32>,
    pub(super) sort_tile: RadixSort,
    pub(super) gradients: Option<Buffer<f32>>,
}

impl PerIntersection {
    pub(super) fn plan(adapter: &AdapterReport, capacity: usize, tile_bits: u32) -> Plan<'static, Self> {
        planned!(Self {
            capacity: Plan::value(capacity),
            by_tile: Pairs::plan(capacity).and(Pairs::plan(capacity)),
            slot_ids: Plan::buffer("slot ids", capacity),
            list: Plan::buffer("tile lists", capacity),
            sort_tile: RadixSort::plan(adapter, capacity, tile_bits, INTERSECTIONS),
            gradients: Plan::value(None),
        })
    }

    /// Plans the gradients of the backward pass.
    pub(super) fn gradient_plan(capacity: usize) -> Plan<'static, Buffer<f32>> {
        Plan::buffer("gradients of slots", SLOT_FLOATS * capacity)
    }
}

/// Buffers with a row for each pixel or tile of the last view; smaller images use a part of them.
#[derive(Debug)]
pub(super) struct PerImage {
    pub(super) tiles: u32,
    pub(super) image: Buffer<[f32; 4]>,
    pub(super) last: Buffer<u32>,
    pub(super) ranges: Buffer<[u32; 2]>,
}

impl PerImage {
    /// Plans the buffers of images of `size`; those of `old` with enough memory are kept.
    pub(super) fn plan(size: [u32; 2], old: Option<&Self>) -> Plan<'_, Self> {
        let pixels = size[0] as usize * size[1] as usize;
        let tiles = tiles(size);
        planned!(Self {
            tiles: Plan::value(tiles),
            image: Plan::resized("image", pixels, old.map(|old| &old.image)),
            last: Plan::resized("last contributors", pixels, old.map(|old| &old.last)),
            ranges: Plan::resized("tile ranges", tiles as usize, old.map(|old| &old.ranges)),
        })
    }
}

pub(super) fn counter_plan() -> Plan<'static, Buffer<u32>> {
    Plan::buffer("counters", COUNTERS)
}

pub(super) fn tiles(size: [u32; 2]) -> u32 {
    size[0].div_ceil(TILE) * size[1].div_ceil(TILE)
}

pub(super) fn tile_bits(tiles: u32) -> u32 {
    tiles.next_power_of_two().trailing_zeros()
}
