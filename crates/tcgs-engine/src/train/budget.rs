//! Estimates the memory of a training run before it starts, and the model size that a budget allows.
//!
//! The figures are the bytes of the buffers' plans ([`crate::gpu::Plan`]) for the largest model that the schedule allows. Two are
//! assumed, since they are not known beforehand: the pairs of Gaussian and tile of a view (`PAIRS_A_TILE`), and the memory of
//! program and driver (`PROGRAM_BYTES`). The device's budget is also enforced while training
//! ([`crate::gpu::GpuError::OverBudget`]), so a scene beyond the assumptions ends the run with an error and not the process.

use super::{
    ColorCorrections, Estimate, ImageLoss, OverBudget, PhotographPlace, PhotographTooLarge, RunTooLarge,
    Schedule,
    batch::REPORT_INTERVAL,
    footprint::{AnchorFootprint, Footprint, PlainFootprint},
    loss::binding_limit,
    memory_estimate::Part,
    photographs::AHEAD,
    set_sizes::SetSizes,
};
use crate::{
    domain::{Dataset, Exposure, MemoryBudget, ModelKind, TrainOptions},
    eval::measuring_bytes,
    gpu::{AdapterReport, CONSTANT_BYTES},
    render::Rasterizer,
};

/// Pairs of Gaussian and tile that a view is assumed to make at most, for each of its tiles; few scenes make half.
const PAIRS_A_TILE: usize = 512;

/// Main memory of the program and a software driver with its compiled kernels.
const PROGRAM_BYTES: u64 = 256 << 20;

/// Host bytes a pixel of the photograph of a step, packed and on its way to the device, and of those that are prepared ahead: as
/// stored, over the background, packed.
const STEP_BYTES_A_PIXEL: u64 = 4 + 4 + AHEAD as u64 * (4 + 3 + 4);

/// Bytes a pixel of a packed photograph.
const PACKED: u64 = size_of::<u32>() as u64;

/// Most photographs on their way to the device: those of the steps of two batches.
const IN_FLIGHT: u64 = 2 * REPORT_INTERVAL as u64;

/// Host bytes a point of the cloud: position and color, both in the frame too, a copy of the position there, and its cell in sets and
/// trees.
const POINT_BYTES: u64 = 27 + 15 + 12 + 128;

/// What decides how much a run takes.
#[derive(Debug)]
pub struct Needs<'a> {
    adapter: &'a AdapterReport,
    footprint: Box<dyn Footprint>,
    /// Size of the image with the most pixels.
    largest: [u32; 2],
    /// Whether there are images of other sizes.
    mixed: bool,
    photographs: u64,
    /// Whether there are masks.
    masked: bool,
    /// Bytes of the training photographs that may be kept packed: those in memory.
    packed: u64,
    /// Points of the cloud, or random ones.
    points: usize,
    /// Photographs with color corrections; none in a run without.
    corrected: usize,
}

impl<'a> Needs<'a> {
    /// Of a run on `dataset`, with color corrections only where `options` say `exposure=on`.
    #[must_use]
    pub fn of(dataset: &Dataset, options: &TrainOptions, adapter: &'a AdapterReport) -> Self {
        Self::of_sizes(SetSizes::of(dataset), options, adapter)
    }

    /// Of a run on a dataset of these sizes.
    #[must_use]
    pub fn of_sizes(sizes: SetSizes, options: &TrainOptions, adapter: &'a AdapterReport) -> Self {
        let SetSizes { largest, mixed, photographs, training, masked, packed, points } = sizes;
        let schedule = Schedule::new(options).for_points(points == 0);
        Self {
            adapter,
            largest,
            mixed,
            photographs,
            masked,
            packed,
            points: if points > 0 { points } else { schedule.random_points },
            corrected: match options.exposure {
                Exposure::On => training,
                Exposure::Auto | Exposure::Off => 0,
            },
            footprint: match options.model {
                ModelKind::Tcgs | ModelKind::Scaffold => Box::new(AnchorFootprint {
                    shape: schedule.shape,
                    max_anchors: schedule.max_anchors,
                    two_stages: schedule.plain_until > 0,
                    masks: schedule.masks.is_some(),
                    compression: schedule.compression,
                }),
                ModelKind::Gaussians3d => {
                    Box::new(PlainFootprint { max_gaussians: schedule.plain.max_gaussians })
                }
            },
        }
    }

    /// What a run takes whose model grows to `size` and that keeps no packed photographs.
    #[must_use]
    pub fn estimate(&self, size: usize) -> Estimate {
        self.estimate_with(size, PhotographPlace::Nowhere)
    }

    /// What a run takes whose model grows to `size` and that keeps packed photographs in `photographs`.
    #[must_use]
    pub fn estimate_with(&self, size: usize, photographs: PhotographPlace) -> Estimate {
        let model = &self.footprint;
        let gaussians = model.gaussians(size);
        let [width, height] = self.largest.map(u64::from);
        let pixels = width * height;
        // Buffers for larger images are made before those for smaller ones are given back.
        let sizes = if self.mixed { 2 } else { 1 };
        let raster = |gaussians, pairs| Rasterizer::bytes(self.adapter, gaussians, pairs, self.largest);
        let pairs = self.pairs(gaussians);
        let part = |name, bytes| Part { name, bytes };
        // With a mask, both images are copied once more.
        let measuring = if self.masked { measuring_bytes(pixels) * 3 / 2 } else { measuring_bytes(pixels) };
        let of_steps = (sizes + IN_FLIGHT) * PACKED * pixels;
        let [on_device, on_host] = match photographs {
            PhotographPlace::Device => [self.packed, 0],
            PhotographPlace::Host => [of_steps, self.packed],
            PhotographPlace::Nowhere => [of_steps, 0],
        };
        let mut estimate = Estimate {
            size,
            unit: model.unit(),
            photographs,
            gpu: vec![
                part("model and optimizer", model.model_bytes(size)),
                part("Gaussians of a view", model.view_bytes(size)),
                part("rasterizer", raster(gaussians, pairs) + (sizes - 1) * raster(0, 0)),
                part("loss", sizes * ImageLoss::bytes(self.adapter, self.largest)),
                part("packed photographs", on_device),
                part("constants", CONSTANT_BYTES),
            ],
            host: vec![
                part("photographs", self.photographs),
                part("packed photographs", on_host),
                // Views are measured when no step runs.
                part("photographs in use", (STEP_BYTES_A_PIXEL * pixels).max(measuring)),
                part("points", POINT_BYTES * self.points as u64),
                part("growth", model.host_bytes(size)),
                part("program", PROGRAM_BYTES),
            ],
        };
        if self.corrected > 0 {
            let bytes = sizes * ColorCorrections::bytes(self.corrected, pixels as usize);
            estimate.gpu.push(part("color corrections", bytes));
        }
        estimate
    }

    /// Pairs of Gaussian and tile that the rasterizer is assumed to make room for.
    fn pairs(&self, gaussians: usize) -> usize {
        let tiles = self.largest.map(|side| side.div_ceil(16) as usize);
        let assumed =
            (tiles[0] * tiles[1] * PAIRS_A_TILE).min(Rasterizer::max_bindable_intersections(self.adapter));
        Rasterizer::default_intersections(self.adapter, gaussians).max(assumed)
    }

    /// The largest run that `budget` allows: the schedule's, or one that stops growing earlier but still holds what the points
    /// begin with. It keeps packed photographs where there is memory left for them.
    ///
    /// # Errors
    /// [`RunTooLarge`] if there is none.
    pub fn within(&self, budget: &MemoryBudget) -> Result<Estimate, RunTooLarge> {
        self.check_photographs()?;
        let size = self.largest_within(budget)?;
        // Where both are one memory, photographs count as main memory, which they come from.
        let places: &[PhotographPlace] = if self.adapter.shares_main_memory() {
            &[PhotographPlace::Host]
        } else {
            &[PhotographPlace::Device, PhotographPlace::Host]
        };
        let mut kept =
            places.iter().filter(|_| self.packed > 0).map(|place| self.estimate_with(size, *place));
        Ok(kept.find(|kept| kept.fits(budget)).unwrap_or_else(|| self.estimate(size)))
    }

    /// Checks that the adapter can bind the buffers of the largest photograph, which no smaller model makes smaller.
    fn check_photographs(&self) -> Result<(), PhotographTooLarge> {
        let (size, limit) = (self.largest, binding_limit(self.adapter));
        let needed = |size| ImageLoss::largest_buffer_bytes(self.adapter, size);
        if needed(size) <= limit {
            return Ok(());
        }
        let [width, height] = size.map(u64::from);
        // As photographs are downscaled.
        let downscaled = |to: u32| [to, (height * u64::from(to) / width).max(1) as u32];
        let (mut fits, mut too_wide) = (1, size[0]);
        while too_wide - fits > 1 {
            let middle = fits + (too_wide - fits) / 2;
            if needed(downscaled(middle)) <= limit {
                fits = middle;
            } else {
                too_wide = middle;
            }
        }
        Err(PhotographTooLarge { size, needed: needed(size), limit, max_width: fits })
    }

    /// The size of the largest run that `budget` allows without packed photographs.
    fn largest_within(&self, budget: &MemoryBudget) -> Result<usize, OverBudget> {
        let max_size = self.footprint.max_size(self.adapter);
        // Growth takes the other half.
        let min = self.points.min(max_size / 2).max(1);
        let wanted = self.estimate(max_size);
        if wanted.fits(budget) {
            return Ok(max_size);
        }
        let needed = self.estimate(min);
        if !needed.fits(budget) {
            return Err(OverBudget { needed: Box::new(needed), budget: *budget });
        }
        let (mut fits, mut too_many) = (min, max_size);
        while too_many - fits > 1 {
            let middle = fits + (too_many - fits) / 2;
            if self.estimate(middle).fits(budget) {
                fits = middle;
            } else {
                too_many = middle;
            }
        }
        Ok(fits)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        domain::{
            Camera, Digest, Frame, Image, Intrinsics, Layout, PointCloud, Pose, Problem, ProblemType, Split,
        },
        gpu::testing::software_report,
    };

    const MIB: u64 = 1 << 20;

    fn dataset(sizes: &[(u32, u32)], points: usize) -> Dataset {
        let pose = Pose::look_at(glam::DVec3::X, glam::DVec3::ZERO, glam::DVec3::Z).expect("a view");
        let frames = sizes.iter().enumerate().map(|(index, (width, height))| {
            let intrinsics = Intrinsics::from_horizontal_fov(1.0, *width, *height).expect("intrinsics");
            let samples = vec![0; 3 * (width * height) as usize];
            Frame {
                name: index.to_string(),
                camera: Camera::new(intrinsics, pose).expect("a camera"),
                image: Image::new(*width, *height, 3, samples).expect("an image").into(),
                mask: None,
                split: Split::Train,
            }
        });
        let points = PointCloud { positions: vec![[0.0; 3]; points], colors: vec![[0; 3]; points] };
        Dataset {
            layout: Layout::Colmap,
            frames: frames.collect(),
            points: (!points.positions.is_empty()).then_some(points),
            digest: Digest::of(b"budget"),
            notes: Vec::new(),
        }
    }

    #[test]
    fn more_anchors_larger_images_and_more_sizes_take_more() {
        let (adapter, options) = (software_report(), TrainOptions::default());
        let small = dataset(&[(64, 48)], 100);
        let needs = Needs::of(&small, &options, &adapter);
        let mut before = needs.estimate(1);
        for anchors in [10, 1_000, 10_000, 40_000] {
            let now = needs.estimate(anchors);
            assert!(now.gpu_bytes() > before.gpu_bytes() && now.host_bytes() > before.host_bytes());
            before = now;
        }
        let at = |sizes: &[(u32, u32)]| {
            Needs::of(&dataset(sizes, 100), &options, &adapter).estimate(1000).gpu_bytes()
        };
        assert!(at(&[(640, 480)]) > at(&[(64, 48)]));
        assert_eq!(at(&[(640, 480), (640, 480)]), at(&[(640, 480)]));
        assert!(at(&[(640, 480), (480, 640)]) > at(&[(640, 480)]));
        let corrected = TrainOptions { exposure: Exposure::On, ..options.clone() };
        let [without, with] = [&options, &corrected]
            .map(|options| Needs::of(&small, options, &adapter).estimate(1000).gpu_bytes());
        assert!(with >= without + 16 * 64 * 48, "a corrected render");
    }

    #[test]
    fn a_tight_budget_lowers_the_anchors_to_the_most_that_fit() {
        let (adapter, options) = (software_report(), TrainOptions::default());
        let dataset = dataset(&[(64, 48)], 500);
        let needs = Needs::of(&dataset, &options, &adapter);
        let ample = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
        let all = needs.within(&ample).expect("no bound");
        assert_eq!(all.size, Schedule::new(&options).max_anchors);
        let half = MemoryBudget { gpu: all.gpu_bytes() / 2, ..ample };
        let some = needs.within(&half).expect("fewer anchors");
        assert!(some.size > all.size / 3 && some.size < all.size, "{}", some.size);
        assert!(some.fits(&half) && !needs.estimate(some.size + 1).fits(&half));
        let tight = MemoryBudget { host: all.host_bytes() - MIB, ..ample };
        let some = needs.within(&tight).expect("fewer anchors");
        assert!(some.size < all.size && some.fits(&tight));
    }

    #[test]
    fn photographs_beyond_what_the_adapter_binds_are_refused_with_a_width_that_fits() {
        let (adapter, options) = (software_report(), TrainOptions::default());
        let ample = MemoryBudget { host: u64::MAX, gpu: u64::MAX };
        let within = |largest| {
            let one = SetSizes::of(&dataset(&[(64, 48)], 100));
            Needs::of_sizes(SetSizes { largest, ..one }, &options, &adapter).within(&ample)
        };
        assert!(within([3200, 2400]).is_ok());
        for size in [[4000, 3000], [3000, 4000], [8192, 8192]] {
            let error = within(size).expect_err("beyond 8.4 megapixels");
            let RunTooLarge::Photograph(PhotographTooLarge { needed, limit, max_width, .. }) = error else {
                panic!("another error: {error}")
            };
            assert!(needed > limit && limit == 128 * MIB);
            let at = |width: u32| [width, (size[1] * width / size[0])];
            assert!(within(at(max_width)).is_ok() && within(at(max_width + 1)).is_err(), "{max_width}");
            let problem = Problem::from(error);
            assert!(problem.is(ProblemType::SceneTooLarge));
            let [width, height] = size;
            for words in [&format!("{width} x {height}"), "128.0 MiB", &format!("max_width of {max_width}")] {
                assert!(problem.detail.contains(words), "'{}' should say '{words}'", problem.detail);
            }
        }
    }

    #[test]
    fn what_cannot_hold_the_points_is_refused_with_every_part_and_what_to_do() {
        let (adapter, options) = (software_report(), TrainOptions::default());
        let dataset = dataset(&[(64, 48)], 15_000);
        let budget = MemoryBudget { host: u64::MAX, gpu: 16 * MIB };
        let error = Needs::of(&dataset, &options, &adapter).within(&budget).expect_err("too little");
        let RunTooLarge::OverBudget(error) = error else { panic!("another error: {error}") };
        assert_eq!(error.needed.size, 15_000);
        let problem = Problem::from(RunTooLarge::from(error));
        assert_eq!(problem.status, 507);
        for words in ["16.0 MiB", "15000 anchors", "rasterizer", "photographs", "--gpu-memory", "smaller"] {
            assert!(problem.detail.contains(words), "'{}' should say '{words}'", problem.detail);
        }
    }
}
