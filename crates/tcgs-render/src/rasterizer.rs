//! The rasterizer: from Gaussians and a camera to an image, and back to gradients.
//!
//! Invariants: nothing is read back while recording; counts found on the device bound all work there; on one adapter the same
//! input gives the same bits, because every sum has a fixed order.
//!
//! Forward: `project` culls and counts tiles, `compact` lists the visible, a stable sort orders them by depth, `emit`
//! writes one (tile, slot) pair for each tile that a Gaussian touches, a stable sort groups them by tile, `tile_ranges`
//! finds the tiles' lists, `raster_forward` blends them. Backward: `raster_backward` writes one gradient for each slot, `gather`
//! sums the slots of each visible Gaussian, `project_backward` differentiates its projection, `clear_culled` writes zeros for the
//! others.

use std::sync::Arc;

use super::{
    GEOMETRY_SECTIONS, GaussianGradients, Gaussians, RasterSettings, RenderError, Result,
    projection::{Projection, TILE, View},
    raster_buffers::{
        COMPLETED, INTERSECTIONS, PerGaussian, PerImage, PerIntersection, REQUIRED, SLOT_FLOATS, SPLAT_ROWS,
        VISIBLE, counter_plan, tile_bits, tiles,
    },
};
use crate::{
    domain::Camera,
    gpu::{
        AdapterReport, Binding, Buffer, Device, GpuError, Kernel, KernelVariant, MIN_LANES, RadixSort,
        Recorder, Subgroups, kernel_source, twin,
    },
};

/// Lanes of a tile, four pixels each.
const TILE_LANES: u32 = TILE * TILE / 4;

/// Counts of the last forward pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RasterCounts {
    /// Gaussians that touch a tile.
    pub visible: u32,
    /// Pairs of Gaussian and tile, including those beyond the capacity.
    pub intersections: u32,
    /// Whether they exceed the capacity: the image is incomplete; grow and render again.
    pub overflowed: bool,
}

/// Outcome of the forward passes since the last query.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ForwardPasses {
    /// Passes whose intersections all fitted, up to the first that overflowed.
    pub completed: u32,
    /// Capacity that the first overflowed pass requires, if there is one. That pass and all after it have no effect.
    pub required: Option<usize>,
}

#[derive(Debug)]
struct Kernels {
    project: Arc<Kernel>,
    compact: Arc<Kernel>,
    tile_counts: Arc<Kernel>,
    emit: Arc<Kernel>,
    tile_ranges: Arc<Kernel>,
    raster_forward: Arc<Kernel>,
    raster_backward: Arc<Kernel>,
    removal_loss: Arc<Kernel>,
    gather: Arc<Kernel>,
    clear_culled: Arc<Kernel>,
    project_backward: Arc<Kernel>,
    /// Workgroups of the forward kernel for each tile.
    groups_a_tile: u32,
}

impl Kernels {
    fn new(device: &Device, subgroups: Subgroups) -> Result<Self, GpuError> {
        // Where subgroups may be wider than their smallest size, each workgroup is one subgroup.
        let narrow = match subgroups {
            Subgroups::AtLeast(lanes) => Some(lanes),
            Subgroups::Exactly(_) | Subgroups::Unused => None,
        };
        let lanes = subgroups.lanes();
        let eight = lanes.filter(|lanes| *lanes == 8).map(|_| ("EIGHT_LANES", 1));
        let subgroups: Vec<_> = lanes.map(|lanes| ("SUBGROUPS", lanes)).into_iter().collect();
        let one = narrow.map(|_| ("ONE_SUBGROUP", 1));
        let forward: Vec<_> = subgroups.iter().copied().chain(eight).chain(one).collect();
        Ok(Self {
            groups_a_tile: narrow.map_or(1, |lanes| TILE_LANES / lanes),
            project: device.kernel(kernel_source!("project"), &[("RUN", device.variant().choose(16, 1))])?,
            compact: device.kernel(kernel_source!("compact"), &[])?,
            tile_counts: device.kernel(kernel_source!("tile_counts"), &[])?,
            emit: device.kernel(kernel_source!("emit"), &[])?,
            tile_ranges: device.kernel(kernel_source!("tile_ranges"), &[])?,
            raster_forward: device.kernel(kernel_source!("raster_forward"), &forward)?,
            raster_backward: device.kernel(kernel_source!("raster_backward"), &subgroups)?,
            removal_loss: removal_loss_kernel(device, None)?,
            gather: gather_kernel(device)?,
            clear_culled: device.kernel(kernel_source!("clear_culled"), &[])?,
            project_backward: device.kernel(kernel_source!("project_backward"), &[])?,
        })
    }
}

/// The kernel of removal losses, with the definition of its variant for corrected renders or without.
fn removal_loss_kernel(device: &Device, corrected: Option<(&str, u32)>) -> Result<Arc<Kernel>, GpuError> {
    let lanes = ("LANES", device.variant().choose(16, 64));
    let definitions: Vec<_> = std::iter::once(lanes).chain(corrected).collect();
    device.kernel(kernel_source!("removal_loss"), &definitions)
}

/// A kernel that writes a row for each slot, and its input.
struct SlotPass<'a> {
    kernel: &'a Kernel,
    /// A value for each pixel.
    input: Binding<'a>,
    pixels: usize,
    /// Of the input.
    name: &'static str,
    /// What the kernel binds last, if anything.
    uniform: Option<Binding<'a>>,
}

/// An affine color correction of a photograph: three rows, each a row of A and then the component of b. The loss compares the photograph
/// with `A c + b` of the render's colors c.
pub type CorrectionRows = [[f32; 4]; 3];

/// Renders Gaussians and differentiates the rendering.
///
/// Its buffers are reused, so only the last forward pass can be read or differentiated.
#[derive(Debug)]
pub struct Rasterizer {
    device: Arc<Device>,
    settings: RasterSettings,
    kernels: Kernels,
    /// Of the last forward pass.
    view: View,
    counters: Buffer<u32>,
    initial_capacity: Option<usize>,
    gaussians: PerGaussian,
    intersections: PerIntersection,
    image: PerImage,
    /// The camera of the last forward pass, and whether the second of the two pairs holds its slots by tile.
    rendered: Option<(Camera, bool)>,
}

impl Rasterizer {
    /// Prepares the kernels; buffers are made by the first forward pass.
    pub fn new(device: Arc<Device>, settings: RasterSettings) -> Result<Self> {
        let subgroups = device.subgroups();
        Self::with_subgroups(device, settings, subgroups)
    }

    /// As [`Rasterizer::new`], with the kernels without subgroups, for adapters whose subgroups are broken.
    pub fn without_subgroups(device: Arc<Device>, settings: RasterSettings) -> Result<Self> {
        Self::with_subgroups(device, settings, Subgroups::Unused)
    }

    fn with_subgroups(device: Arc<Device>, settings: RasterSettings, subgroups: Subgroups) -> Result<Self> {
        let enough = subgroups.lanes().is_some_and(|lanes| lanes >= MIN_LANES);
        let kernels = Kernels::new(&device, if enough { subgroups } else { Subgroups::Unused })?;
        Ok(Self {
            settings,
            kernels,
            view: View::of_rows(0, 0),
            counters: counter_plan().make(&device)?,
            initial_capacity: None,
            gaussians: PerGaussian::plan(device.adapter(), 0).make(&device)?,
            intersections: PerIntersection::plan(device.adapter(), 0, 0).make(&device)?,
            image: PerImage::plan([0, 0], None).make(&device)?,
            rendered: None,
            device,
        })
    }

    /// Bytes on the device once views of `size` with `gaussians` rows and `intersections` pairs were rendered and
    /// differentiated.
    #[must_use]
    pub fn bytes(adapter: &AdapterReport, gaussians: usize, intersections: usize, size: [u32; 2]) -> u64 {
        let tile_bits = tile_bits(tiles(size));
        counter_plan().bytes()
            + PerGaussian::plan(adapter, gaussians).bytes()
            + PerIntersection::plan(adapter, intersections, tile_bits).bytes()
            + PerIntersection::gradient_plan(intersections).bytes()
            // Smaller images have passes of their own.
            + (0..tile_bits).map(|bits| RadixSort::pass_bytes(adapter, bits)).sum::<u64>()
            + PerImage::plan(size, None).bytes()
    }

    /// Bytes of the largest buffer with a row for each of `gaussians` Gaussians.
    pub(super) fn largest_bytes(adapter: &AdapterReport, gaussians: usize) -> u64 {
        PerGaussian::plan(adapter, gaussians).largest_bytes()
    }

    /// Initial capacity for pairs: enough for most scenes, and no more than the backward pass can bind.
    #[must_use]
    pub fn default_intersections(adapter: &AdapterReport, gaussians: usize) -> usize {
        (2 * gaussians).min(Self::max_bindable_intersections(adapter)).max(1 << 14)
    }

    /// Intersections whose gradients the backward pass can bind.
    #[must_use]
    pub fn max_bindable_intersections(adapter: &AdapterReport) -> usize {
        adapter.max_binding_bytes as usize / (SLOT_FLOATS * size_of::<f32>())
    }

    /// Records the rendering of `gaussians` over `background` (linear r, g, b) into [`Rasterizer::image`].
    ///
    /// # Errors
    /// [`RenderError::Length`] if a column is shorter than the capacity; faults of the device.
    pub fn forward(
        &mut self,
        recorder: &mut Recorder<'_>,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<()> {
        self.rendered = None;
        check_columns(gaussians)?;
        let projection = Projection::new(camera, &self.settings);
        self.fit(gaussians.capacity, &projection)?;
        self.view = View::new(&projection, background, gaussians, self.intersections.capacity);
        let view = recorder.uniform(&[self.view])?;
        self.order(recorder, &view, gaussians);
        let slots = self.list(recorder, &view);
        self.blend(recorder, &view);
        self.rendered = Some((*camera, slots));
        Ok(())
    }

    /// The image of the last forward pass, row by row: red, green, blue over the background, and the transmittance left.
    #[must_use]
    pub fn image(&self) -> &Buffer<[f32; 4]> {
        &self.image.image
    }

    /// Reads back the counts of the last submitted forward pass. Waits for the device.
    pub fn counts(&self) -> Result<RasterCounts> {
        Ok(Self::counts_of(&self.device.read(&self.counters)?, self.capacity()))
    }

    /// What [`Rasterizer::counts_of`] reads, after a submitted forward pass.
    pub(super) fn counters(&self) -> &Buffer<u32> {
        &self.counters
    }

    /// The number of intersections that there is room for.
    pub(super) fn capacity(&self) -> usize {
        self.intersections.capacity
    }

    /// The counts in a copy of the counters of a pass with room for `capacity` intersections.
    pub(super) fn counts_of(counters: &[u32], capacity: usize) -> RasterCounts {
        let intersections = counters[INTERSECTIONS as usize];
        RasterCounts {
            visible: counters[VISIBLE as usize],
            intersections,
            overflowed: intersections as usize > capacity,
        }
    }

    /// Submits what `record` records, a forward pass at its end, until there is room for all intersections; returns their counts.
    /// Waits for the device.
    pub fn submit_with_room(
        &mut self,
        label: &str,
        mut record: impl FnMut(&mut Self, &mut Recorder<'_>) -> Result<()>,
    ) -> Result<RasterCounts> {
        let device = Arc::clone(&self.device);
        loop {
            let mut recorder = device.recorder(label);
            record(self, &mut recorder)?;
            recorder.submit()?;
            let counts = self.counts()?;
            if !counts.overflowed {
                return Ok(counts);
            }
            self.grow(&counts)?;
        }
    }

    /// Grows to the capacity that `counts` require, and a quarter more; record the forward pass again afterwards.
    ///
    /// # Errors
    /// [`GpuError::BufferTooLarge`] beyond the adapter's limits; faults of the device.
    pub fn grow(&mut self, counts: &RasterCounts) -> Result<()> {
        if counts.overflowed {
            self.reserve(counts.intersections as usize)?;
        }
        Ok(())
    }

    /// Grows to a capacity of `wanted` intersections, and a quarter more.
    ///
    /// # Errors
    /// As [`Rasterizer::grow`].
    pub fn reserve(&mut self, wanted: usize) -> Result<()> {
        self.rendered = None;
        let tile_bits = tile_bits(self.image.tiles);
        let adapter = self.device.adapter();
        let capacity = grown_capacity(wanted, Self::max_bindable_intersections(adapter));
        self.intersections = PerIntersection::plan(adapter, capacity, tile_bits).make(&self.device)?;
        Ok(())
    }

    /// Sets the initial capacity for intersections, to test overflow.
    pub fn set_initial_capacity(&mut self, intersections: usize) {
        self.initial_capacity = Some(intersections);
    }

    /// Not zero on the device from the first forward pass that overflows until [`Rasterizer::take_forward_passes`]. While it is
    /// set, kernels must not change any state that outlasts the step.
    #[must_use]
    pub fn overflow_flag(&self) -> &Buffer<u32> {
        &self.counters
    }

    /// Returns the outcome of the forward passes since the last call, and resets it. Waits for the device. After an overflow, call
    /// [`Rasterizer::reserve`] and record that pass and those after it again.
    pub fn take_forward_passes(&self) -> Result<ForwardPasses> {
        let counters = self.device.read(&self.counters)?;
        self.reset_forward_passes();
        Ok(self.forward_passes(&counters))
    }

    /// Forgets the forward passes so far, in order with what is submitted.
    pub fn reset_forward_passes(&self) {
        self.device.write_at(&self.counters, REQUIRED, &[0_u32; COMPLETED + 1]);
    }

    /// The outcome of the forward passes since the last reset, from a copy of [`Rasterizer::overflow_flag`].
    #[must_use]
    pub fn forward_passes(&self, counters: &[u32]) -> ForwardPasses {
        let needed = counters[REQUIRED] as usize;
        ForwardPasses { completed: counters[COMPLETED], required: (needed > 0).then_some(needed) }
    }

    /// Records the gradients of a loss whose derivatives by the image (red, green, blue, alpha = 1 - transmittance) are
    /// `d_image`. Follows the forward pass of the same camera and Gaussians.
    ///
    /// # Errors
    /// [`RenderError::OutOfStep`] without that forward pass; [`RenderError::Length`]; faults of the device.
    pub fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        gaussians: &Gaussians,
        camera: &Camera,
        d_image: &Buffer<[f32; 4]>,
        out: &GaussianGradients,
    ) -> Result<()> {
        let kernel = Arc::clone(&self.kernels.raster_backward);
        let pass = SlotPass {
            kernel: &kernel,
            input: d_image,
            pixels: d_image.len(),
            name: "the image's gradient",
            uniform: None,
        };
        self.over_slots(recorder, gaussians, camera, pass, out)
    }

    /// Records by how much the absolute error of the view against `photograph`, summed over channels and pixels that count, would
    /// change without each Gaussian alone: the opacity's column of `out`. The error is that of the render through the photograph's
    /// `correction`, if it has one. Follows the forward pass of the same camera and Gaussians.
    ///
    /// # Errors
    /// As [`Rasterizer::backward`].
    pub fn removal_loss(
        &mut self,
        recorder: &mut Recorder<'_>,
        gaussians: &Gaussians,
        camera: &Camera,
        photograph: &Buffer<u32>,
        correction: Option<&CorrectionRows>,
        out: &GaussianGradients,
    ) -> Result<()> {
        let kernel = match correction {
            // Few runs need it, so it is compiled on its first use.
            Some(_) => removal_loss_kernel(&self.device, Some(("CORRECTED", 1)))?,
            None => Arc::clone(&self.kernels.removal_loss),
        };
        let uniform = correction.map(|rows| recorder.uniform(rows)).transpose()?;
        let pass = SlotPass {
            kernel: &kernel,
            input: photograph,
            pixels: photograph.len(),
            name: "the photograph",
            uniform: uniform.as_ref().map(|uniform| uniform as Binding<'_>),
        };
        self.over_slots(recorder, gaussians, camera, pass, out)
    }

    /// Records a pass over the slots of the last forward pass, and brings the sums of its rows to the Gaussians.
    fn over_slots(
        &mut self,
        recorder: &mut Recorder<'_>,
        gaussians: &Gaussians,
        camera: &Camera,
        pass: SlotPass<'_>,
        out: &GaussianGradients,
    ) -> Result<()> {
        let slots_in_spare = match self.rendered {
            Some((rendered, in_spare))
                if rendered == *camera && gaussians.capacity == self.gaussians.capacity =>
            {
                in_spare
            }
            _ => return Err(RenderError::OutOfStep),
        };
        check_columns(gaussians)?;
        check_gradients(out, gaussians.capacity)?;
        check(pass.name, pass.pixels, self.image.image.len())?;
        let slot_gradients = match &self.intersections.gradients {
            Some(buffer) => buffer.clone(),
            None => {
                let buffer =
                    PerIntersection::gradient_plan(self.intersections.capacity).make(&self.device)?;
                self.intersections.gradients.insert(buffer).clone()
            }
        };
        let kernels = &self.kernels;
        let view = &recorder.uniform(&[self.view])?;
        let (own, lists, image) = (&self.gaussians, &self.intersections, &self.image);
        let by_slot = if slots_in_spare { &lists.by_tile.1 } else { &lists.by_tile.0 };
        let bindings: [Binding<'_>; 9] = [
            view,
            &image.ranges,
            &lists.list,
            &by_slot.values,
            &own.splats,
            &image.image,
            &image.last,
            pass.input,
            &slot_gradients,
        ];
        let bindings: Vec<Binding<'_>> = bindings.into_iter().chain(pass.uniform).collect();
        recorder.dispatch(pass.kernel, &bindings, image.tiles);
        let groups = self.groups(own.capacity);
        let ids =
            if own.sort_depth.ends_in_spare() { &own.by_depth.1.values } else { &own.by_depth.0.values };
        recorder.dispatch(
            &kernels.gather,
            &[view, &self.counters, ids, &own.tiles, &own.first_slots, &slot_gradients, &own.d_splats],
            groups,
        );
        let (geometry, colors, means2d) = (&out.geometry, &out.colors, &out.means2d);
        match recorder.variant() {
            KernelVariant::Software => {
                recorder.dispatch(
                    &kernels.clear_culled,
                    &[view, &gaussians.count, &own.tiles, geometry, colors, means2d],
                    groups,
                );
                recorder.dispatch(
                    &kernels.project_backward,
                    &[
                        view,
                        &self.counters,
                        &gaussians.geometry,
                        &own.tiles,
                        &own.d_splats,
                        geometry,
                        colors,
                        means2d,
                        ids,
                    ],
                    groups,
                );
            }
            KernelVariant::Hardware => {
                recorder.dispatch(
                    &kernels.project_backward,
                    &[
                        view,
                        &gaussians.count,
                        &gaussians.geometry,
                        &own.tiles,
                        &own.d_splats,
                        geometry,
                        colors,
                        means2d,
                    ],
                    groups,
                );
            }
        }
        Ok(())
    }

    /// Makes the buffers for these sizes; those with enough memory are kept.
    fn fit(&mut self, capacity: usize, projection: &Projection) -> Result<(), GpuError> {
        let adapter = self.device.adapter();
        if self.gaussians.capacity != capacity {
            self.gaussians = PerGaussian::plan(adapter, capacity).make(&self.device)?;
        }
        let size = projection.size.to_array();
        self.image = PerImage::plan(size, Some(&self.image)).make(&self.device)?;
        let tile_bits = tile_bits(self.image.tiles);
        // `reserve` makes more, which is kept.
        let initial = self.initial_capacity.unwrap_or_else(|| Self::default_intersections(adapter, capacity));
        let intersections = self.intersections.capacity.max(initial);
        if self.intersections.capacity != intersections {
            self.intersections =
                PerIntersection::plan(adapter, intersections, tile_bits).make(&self.device)?;
        }
        self.intersections.sort_tile.set_bits(&self.device, tile_bits)
    }

    /// Workgroups of 64 for `items`; kernels loop where there are fewer invocations than items.
    fn groups(&self, items: usize) -> u32 {
        let max = self.device.variant().choose(128, 4096);
        u32::try_from(items.div_ceil(64)).unwrap_or(max).clamp(1, max)
    }

    /// Records the projection and the ordering of the visible by depth, with the slots where each begins.
    fn order(&self, recorder: &mut Recorder<'_>, view: &Buffer<View>, gaussians: &Gaussians) {
        let (kernels, own) = (&self.kernels, &self.gaussians);
        let groups = self.groups(own.capacity);
        recorder.dispatch(
            &kernels.project,
            &[
                view,
                &gaussians.count,
                &gaussians.geometry,
                &gaussians.colors,
                &own.splats,
                &own.depths,
                &own.tiles,
                &own.visible,
            ],
            groups,
        );
        own.list_visible.record(recorder, &gaussians.count, &own.visible, &own.places, &self.counters);
        let (pairs, spare) = &own.by_depth;
        recorder.dispatch(
            &kernels.compact,
            &[view, &gaussians.count, &own.visible, &own.places, &own.depths, &pairs.keys, &pairs.values],
            groups,
        );
        let sorted = own.sort_depth.record(recorder, &self.counters, pairs, spare);
        recorder.dispatch(
            &kernels.tile_counts,
            &[view, &self.counters, &sorted.values, &own.tiles, &own.sorted_tiles],
            groups,
        );
        own.place_slots.record(recorder, &self.counters, &own.sorted_tiles, &own.starts, &self.counters);
        let (by_tile, _) = &self.intersections.by_tile;
        recorder.dispatch(
            &kernels.emit,
            &[
                view,
                &self.counters,
                &sorted.values,
                &own.starts,
                &own.splats,
                &by_tile.keys,
                &by_tile.values,
                &self.intersections.slot_ids,
                &own.first_slots,
            ],
            groups,
        );
    }

    /// Records the grouping by tile, and returns whether the second of the two pairs holds the slots by tile.
    fn list(&self, recorder: &mut Recorder<'_>, view: &Buffer<View>) -> bool {
        let lists = &self.intersections;
        let (pairs, spare) = &lists.by_tile;
        let sorted = lists.sort_tile.record(recorder, &self.counters, pairs, spare);
        recorder.clear(&self.image.ranges);
        recorder.dispatch(
            &self.kernels.tile_ranges,
            &[
                view,
                &self.counters,
                &sorted.keys,
                &sorted.values,
                &lists.slot_ids,
                &lists.list,
                &self.image.ranges,
            ],
            self.groups(lists.capacity),
        );
        std::ptr::eq(sorted, spare)
    }

    fn blend(&self, recorder: &mut Recorder<'_>, view: &Buffer<View>) {
        let image = &self.image;
        recorder.dispatch(
            &self.kernels.raster_forward,
            &[
                view,
                &image.ranges,
                &self.intersections.list,
                &self.gaussians.splats,
                &image.image,
                &image.last,
            ],
            self.kernels.groups_a_tile * image.tiles,
        );
    }
}

fn gather_kernel(device: &Device) -> Result<Arc<Kernel>, GpuError> {
    device.kernel(kernel_source!("gather"), &[])
}

/// Sums of `gradients` (nine floats per slot) over the slots of each Gaussian, which follow one another and of which there are
/// `tiles`: place and opacity, conic, color, as the backward pass makes them. Waits for the device.
///
/// # Errors
/// [`RenderError::Length`] unless there are as many slots as tiles; faults of the device.
pub fn sum_slots(device: &Device, gradients: &Buffer<f32>, tiles: &[u32]) -> Result<Vec<[f32; SLOT_FLOATS]>> {
    let (count, slots) = (tiles.len(), tiles.iter().map(|tiles| *tiles as usize).sum::<usize>());
    check("the slots", gradients.len(), SLOT_FLOATS * slots)?;
    let kernel = gather_kernel(device)?;
    let view = device.upload("view", &[View::of_rows(count, slots)])?;
    let (first_slots, _) = twin::scan(tiles);
    let sums = device.buffer::<[f32; 4]>("sums of slots", SPLAT_ROWS * count)?;
    let mut counters = vec![0; VISIBLE as usize + 1];
    counters[VISIBLE as usize] = count as u32;
    let counters = device.upload("counters", &counters)?;
    let ids = device.upload("ids", &(0..count as u32).collect::<Vec<_>>())?;
    let tiles = device.upload("tiles", tiles)?;
    let first_slots = device.upload("first slots", &first_slots)?;
    let mut recorder = device.recorder("sums of slots");
    let buffers: [Binding<'_>; 7] = [&view, &counters, &ids, &tiles, &first_slots, gradients, &sums];
    recorder.dispatch(&kernel, &buffers, (count.div_ceil(64) as u32).max(1));
    recorder.submit()?;
    let sums = device.read(&sums)?;
    let (rows, _) = sums.as_chunks::<SPLAT_ROWS>();
    Ok(rows.iter().map(|[p, k, c]| [p[0], p[1], p[2], k[0], k[1], k[2], c[0], c[1], c[2]]).collect())
}

/// A quarter more than is wanted, so that growing is rare, but not so much more that only the spare part cannot be bound.
fn grown_capacity(wanted: usize, bindable: usize) -> usize {
    (wanted + wanted / 4).min(bindable.max(wanted))
}

fn check(what: &'static str, found: usize, expected: usize) -> Result<()> {
    if found == expected { Ok(()) } else { Err(RenderError::Length { what, found, expected }) }
}

fn check_columns(gaussians: &Gaussians) -> Result<()> {
    let expected = gaussians.capacity;
    check("the geometry", gaussians.geometry.len(), GEOMETRY_SECTIONS * expected)?;
    check("colors", gaussians.colors.len(), expected)?;
    check("the count", gaussians.count.len().min(1), 1)
}

fn check_gradients(out: &GaussianGradients, expected: usize) -> Result<()> {
    check("gradients of the geometry", out.geometry.len(), GEOMETRY_SECTIONS * expected)?;
    check("gradients of colors", out.colors.len(), expected)?;
    check("gradients of projected centers", out.means2d.len(), expected)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spare_room_never_makes_what_fits_too_large() {
        assert_eq!(grown_capacity(1000, 10_000), 1250);
        assert_eq!(grown_capacity(9_000, 10_000), 10_000, "fits, though a quarter more would not");
        assert_eq!(grown_capacity(12_000, 10_000), 12_000, "a forward pass alone may still fit");
    }
}
