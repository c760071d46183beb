//! The schedule of a run, in fractions of its length, so that presets of different lengths share one shape. `docs/SCHEDULE.md`
//! lists it for all presets.

mod compression;
mod growth;
mod learning_rate;
mod masks;
mod plain;
mod table;

use std::ops::Range;

pub use compression::{BaseQuantStepRule, CompressionSchedule, CompressionStage};
pub use learning_rate::{Decay, DecayShape};
pub use masks::MaskSchedule;
pub(super) use plain::PlainSchedule;
pub use table::schedule_table;

use self::{
    learning_rate::{anchor_learning_rate, network_learning_rate},
    masks::masks,
};
use super::RateControl;
use crate::{
    domain::{Component, ModelKind, Preset, SceneFrame, TrainOptions, ViewDegree, Voxel},
    init::{PassingUnits, VoxelRule},
    model::ModelShape,
};

/// Steps from which on anchors that were Gaussians begin with [`PassingUnits::RECTIFYING`]: shorter runs do not make up for what it
/// costs at first.
const RECTIFYING_FROM: u32 = 500;

/// How networks see the direction of view in runs of at least [`HARMONICS_FROM`] steps: shorter ones do not learn that much.
const VIEW_DEGREE: ViewDegree = ViewDegree::MAX;
const HARMONICS_FROM: u32 = 500;

/// The coarsest growth cell in lattice cells, as published: growth has three levels, each a quarter of the one before.
const COARSEST_GROWTH: u16 = 16;

/// The same in `preview`, whose lattice follows the points' spacing: two levels, the finest a quarter of that spacing. Its scenes
/// have so few bytes an anchor that two more bits an axis are 3 to 5 % of a file, and offsets say where Gaussians are.
const COARSEST_PREVIEW_GROWTH: u16 = 4;

/// Share of the run in which an anchor model whose points are random is plain Gaussians, and the most steps of it: after them the
/// surfaces are found, however long the run.
const PLAIN_SHARE: f64 = 0.2;
const MAX_PLAIN_STEPS: u32 = 500;

/// When what happens, and how fast parameters learn.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// The kind of model.
    pub model: ModelKind,
    /// Steps in all.
    pub steps: u32,
    /// Widths of the anchor model.
    pub shape: ModelShape,
    /// Whether features and networks begin with the colors of a point cloud (METHOD.md §2.10); else features at 0 and networks
    /// random, as published.
    pub begins_colored: bool,
    /// How the edge of the anchors' cells is chosen.
    pub voxel: VoxelRule,
    /// The coarsest growth cell, in cells; with `voxel=auto` it is as large as the points' spacing.
    pub coarsest_growth: u16,
    /// First step whose view is added to the growth statistics.
    pub statistics_from: u32,
    /// Last step at which an anchor model is plain Gaussians, where its points are random; 0 for none.
    pub plain_until: u32,
    /// First step at which anchors grow and are pruned.
    pub densify_from: u32,
    /// First step at which they no longer do.
    pub densify_until: u32,
    /// Steps between.
    pub densify_every: u32,
    /// Steps in between after which they do not, while the scene adapts to the noise.
    pub densify_pause: Option<Range<u32>>,
    /// Screen-gradient threshold of growth at the coarsest level, until the rate term counts.
    pub growth_threshold: f32,
    /// Whether the threshold follows lambda once the rate term counts; else it stays as published.
    pub grows_by_rate: bool,
    /// Anchors that growth does not go beyond.
    pub max_anchors: usize,
    /// Points that a set without a point cloud begins with.
    pub random_points: usize,
    /// Learning rate of offsets, before it is multiplied by the scene's extent in its frame.
    pub offset: Decay,
    /// Of features.
    pub feature: Decay,
    /// Of log-scalings.
    pub scaling: Decay,
    /// Of the opacity, covariance and color networks.
    pub networks: [Decay; 3],
    /// How networks begin whose anchors were Gaussians.
    pub passing_units: PassingUnits,
    /// Weight of the volume regularizer, for volumes in units of the scene's frame.
    pub volume_weight: f32,
    /// Offset masks; none where they are off.
    pub masks: Option<MaskSchedule>,
    /// Whether offsets that are invisible in all training views are pruned; the baseline keeps every offset, as published.
    pub prunes_invisible: bool,
    /// Whether features change to their own basis before everything is rounded, and channels and offset slots without use go.
    pub prunes_channels: bool,
    /// Steps after which what that will save is estimated, for a target size.
    pub channel_pruning_estimates: Vec<u32>,
    /// Compression-aware training; none for the baseline.
    pub compression: Option<CompressionSchedule>,
    /// The schedule of plain Gaussians.
    pub(super) plain: PlainSchedule,
}

impl Schedule {
    /// The schedule of a scene in `frame`: an edge that is given in world units is one in its units.
    #[must_use]
    pub(super) fn in_frame(mut self, frame: SceneFrame) -> Self {
        if let VoxelRule::Fixed(edge) = &mut self.voxel {
            *edge = (f64::from(*edge) / frame.scale()) as f32;
        }
        self
    }

    /// The schedule of a job's options.
    #[must_use]
    pub fn new(options: &TrainOptions) -> Self {
        let (default_steps, shape, max_anchors, random_points) = match options.preset {
            Preset::Preview => (2_000, ModelShape::new(32, 4), 40_000, 10_000),
            Preset::Standard => (10_000, ModelShape::new(50, 10), 200_000, 20_000),
            Preset::Paper => (30_000, ModelShape::new(50, 10), 400_000, 100_000),
        };
        let steps = options.iterations.unwrap_or(default_steps);
        let part = |fraction: f64| (f64::from(steps) * fraction).round() as u32;
        let sees_harmonics =
            options.has(Component::Harmonics) && options.preset != Preset::Paper && steps >= HARMONICS_FROM;
        let view_degree = if sees_harmonics { VIEW_DEGREE } else { ViewDegree::DEFAULT };
        let prunes_channels = options.has(Component::Basis) && options.preset != Preset::Paper;
        let rate = |published: Decay| anchor_learning_rate(published, steps);
        let compression = CompressionSchedule::new(options, steps);
        let grows_by_rate = compression.is_some() && options.preset != Preset::Paper;
        let coarsest_growth = match (options.preset, options.voxel) {
            (Preset::Preview, Voxel::Auto) => COARSEST_PREVIEW_GROWTH,
            _ => COARSEST_GROWTH,
        };
        let two_stages = options.preset != Preset::Paper && options.model != ModelKind::Gaussians3d;
        Self {
            model: options.model,
            steps,
            shape: ModelShape { view_degree, ..shape },
            begins_colored: options.preset != Preset::Paper,
            voxel: match options.voxel {
                Voxel::Auto => VoxelRule::OfSpacing(f32::from(coarsest_growth).recip()),
                Voxel::Published => VoxelRule::Published,
                Voxel::Edge(edge) => VoxelRule::Fixed(edge as f32),
            },
            coarsest_growth,
            plain_until: if two_stages { part(PLAIN_SHARE).min(MAX_PLAIN_STEPS) } else { 0 },
            statistics_from: part(500.0 / 30_000.0),
            densify_from: part(0.05),
            densify_until: part(0.5),
            // Short runs grow more often: growth, not the last decimal of the gradients' mean, is what they lack.
            densify_every: (steps / 30).clamp(25, 100),
            densify_pause: (options.preset == Preset::Paper && options.model == ModelKind::Tcgs)
                .then(|| part(0.1)..part(4.0 / 30.0)),
            growth_threshold: if grows_by_rate {
                growth::threshold(compression::default_lambda(options.preset))
            } else {
                growth::PUBLISHED
            },
            grows_by_rate,
            max_anchors,
            random_points,
            offset: rate(Decay::exponential(0.01, 1e-4)),
            feature: rate(Decay::constant(0.0075)),
            scaling: rate(Decay::constant(0.007)),
            networks: [
                network_learning_rate(Decay::exponential(2e-3, 2e-5), steps),
                network_learning_rate(Decay::constant(4e-3), steps),
                network_learning_rate(Decay::exponential(8e-3, 5e-5), steps),
            ],
            passing_units: if steps >= RECTIFYING_FROM {
                PassingUnits::RECTIFYING
            } else {
                PassingUnits::LINEAR
            },
            volume_weight: 0.01,
            masks: masks(options, steps),
            prunes_invisible: options.model == ModelKind::Tcgs,
            prunes_channels,
            // Before lambda is first corrected, and when masks have settled.
            channel_pruning_estimates: if prunes_channels && options.max_bytes.is_some() {
                vec![part(0.43), part(0.75) + 1]
            } else {
                Vec::new()
            },
            compression,
            plain: PlainSchedule::new(options, steps),
        }
    }

    /// The same schedule for a set with a point cloud, or with `random` points: an anchor model begins as plain Gaussians where
    /// points are random, and its growth and noise with its anchors.
    #[must_use]
    pub fn for_points(self, random: bool) -> Self {
        let until = self.plain_until;
        if !random || until == 0 {
            return Self { plain_until: 0, ..self };
        }
        Self {
            statistics_from: self.statistics_from.max(until),
            densify_from: self.densify_from.max(until),
            compression: self.compression.map(|compression| compression.not_before(until)),
            plain: self.plain.first_stage(until, self.max_anchors),
            ..self
        }
    }

    /// The share of the schedule that is done after `step`.
    #[must_use]
    pub fn fraction(&self, step: u32) -> f64 {
        f64::from(step) / f64::from(self.steps.max(1))
    }

    /// Whether the host is busy for long after `step`: with passes over the training views, or the choice of a context model.
    pub(super) fn pauses_after(&self, step: u32) -> bool {
        let rounds = |compression: &CompressionSchedule| {
            compression.changes_stage_after(step) && compression.stage(step + 1) == CompressionStage::Rounded
        };
        self.masks.is_some_and(|masks| masks.until == step)
            || self.channel_pruning_estimates.contains(&step)
            || self.compression.as_ref().is_some_and(rounds)
    }

    /// The size that growth may reach: anchors, or plain Gaussians.
    #[must_use]
    pub fn max_size(&self) -> usize {
        if self.model == ModelKind::Gaussians3d { self.plain.max_gaussians } else { self.max_anchors }
    }

    /// Changes the size that growth may reach.
    pub(super) fn set_max_size(&mut self, max_size: usize) {
        if self.model == ModelKind::Gaussians3d {
            self.plain.max_gaussians = max_size;
        } else {
            self.max_anchors = max_size;
            if self.plain_until > 0 {
                self.plain.max_gaussians = max_size;
            }
        }
    }

    /// Weight of the rate term in the loss; zero without one.
    #[must_use]
    pub fn lambda(&self) -> f64 {
        self.compression.as_ref().map_or(0.0, |compression| compression.lambda)
    }

    /// The controller of lambda for a file of at most `max_bytes`, if given: from the first step of the context model until
    /// everything is rounded.
    #[must_use]
    pub fn rate_control(&self, max_bytes: Option<u64>) -> Option<RateControl> {
        let CompressionSchedule { lambda, context_from, rounded_from, .. } = self.compression.as_ref()?;
        let window = *context_from..=(*rounded_from).max(*context_from);
        let masks = self.masks.as_ref().and_then(|masks| masks.growth);
        Some(RateControl::new(*lambda, max_bytes?, window, masks))
    }

    /// The last step before lambda has an effect, where the branches of a rate-distortion curve fork.
    #[must_use]
    pub fn fork_step(&self) -> u32 {
        let first = self.compression.as_ref().map_or(self.steps, |compression| compression.context_from);
        first.saturating_sub(1).clamp(1, self.steps)
    }

    /// Whether the views of `step` count for growth.
    #[must_use]
    pub fn gathers_statistics(&self, step: u32) -> bool {
        step > self.statistics_from && step < self.densify_until
    }

    /// Screen-gradient threshold of growth after `step`, at the coarsest level, where the rate term weighs `lambda`.
    #[must_use]
    pub fn growth_threshold_at(&self, step: u32, lambda: f64) -> f32 {
        let counts = self
            .compression
            .as_ref()
            .is_some_and(|compression| compression.stage(step) >= CompressionStage::Context);
        if self.grows_by_rate && counts { growth::threshold(lambda) } else { self.growth_threshold }
    }

    /// Whether anchors grow and are pruned after `step`.
    #[must_use]
    pub fn densifies(&self, step: u32) -> bool {
        let pauses = self.densify_pause.as_ref().is_some_and(|pause| pause.contains(&step));
        step > self.densify_from
            && step < self.densify_until
            && step.is_multiple_of(self.densify_every)
            && !pauses
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::ModelKind;

    #[test]
    fn a_voxel_is_given_in_world_units_whatever_the_frame() {
        let frame = SceneFrame::new(glam::DVec3::ONE, 2.5).expect("a frame");
        let of =
            |voxel| Schedule::new(&TrainOptions { voxel, ..TrainOptions::default() }).in_frame(frame).voxel;
        assert_eq!(of(Voxel::Edge(0.1)), VoxelRule::Fixed(0.04));
        assert_eq!(of(Voxel::Published), VoxelRule::Published);
    }

    #[test]
    fn the_coarsest_growth_cell_is_as_large_as_the_spacing_unless_a_voxel_is_given() {
        for preset in Preset::ALL {
            let options = |voxel| TrainOptions { preset, voxel, ..TrainOptions::default() };
            let auto = Schedule::new(&options(Voxel::Auto));
            let VoxelRule::OfSpacing(share) = auto.voxel else { panic!("{:?}", auto.voxel) };
            assert_eq!(share * f32::from(auto.coarsest_growth), 1.0, "{preset:?}");
            for voxel in [Voxel::Published, Voxel::Edge(0.1)] {
                assert_eq!(Schedule::new(&options(voxel)).coarsest_growth, 16, "as published");
            }
        }
    }

    #[test]
    fn short_runs_grow_too() {
        for (steps, rounds) in [(400, 7), (1_000, 14), (2_000, 14), (10_000, 44)] {
            let options = TrainOptions { iterations: Some(steps), ..TrainOptions::default() };
            let schedule = Schedule::new(&options);
            let grows = (1..=steps).filter(|step| schedule.densifies(*step)).count();
            assert_eq!(grows, rounds, "{steps} steps");
        }
    }

    #[test]
    fn anchors_of_random_points_come_after_plain_gaussians_and_so_do_their_growth_and_noise() {
        for model in [ModelKind::Tcgs, ModelKind::Scaffold] {
            for (steps, until) in [(1, 0), (300, 60), (2_000, 400), (10_000, 500)] {
                let options = TrainOptions { model, iterations: Some(steps), ..TrainOptions::default() };
                let schedule = Schedule::new(&options).for_points(true);
                assert_eq!(schedule.plain_until, until, "{steps} steps");
                assert!(
                    (1..=until).all(|step| !schedule.densifies(step) && !schedule.gathers_statistics(step))
                );
                assert!(!(1..=steps).any(|step| schedule.plain.resets(step) && step <= until && until > 0));
                assert_eq!(schedule.fork_step(), Schedule::new(&options).fork_step());
                let units = if steps < 500 { PassingUnits::LINEAR } else { PassingUnits::RECTIFYING };
                assert_eq!(schedule.passing_units, units);
                if let Some(compression) = &schedule.compression {
                    assert!(compression.noise_from > until && compression.context_from > until);
                }
            }
        }
        let with_points = Schedule::new(&TrainOptions::default()).for_points(false);
        assert_eq!(with_points, Schedule { plain_until: 0, ..Schedule::new(&TrainOptions::default()) });
        for options in [
            TrainOptions { preset: Preset::Paper, ..TrainOptions::default() },
            TrainOptions { model: ModelKind::Gaussians3d, ..TrainOptions::default() },
        ] {
            assert_eq!(Schedule::new(&options).for_points(true), Schedule::new(&options));
        }
    }

    #[test]
    fn networks_of_tcgs_see_harmonics_but_not_in_short_runs_nor_as_published() {
        let degree = |options: TrainOptions| Schedule::new(&options).shape.view_degree.get();
        let usual = |steps: u32| TrainOptions { iterations: Some(steps), ..TrainOptions::default() };
        assert_eq!([1, 499, 500, 2_000].map(|steps| degree(usual(steps))), [1, 1, 3, 3]);
        assert_eq!(degree(TrainOptions { preset: Preset::Standard, ..TrainOptions::default() }), 3);
        for options in [
            TrainOptions { preset: Preset::Paper, ..TrainOptions::default() },
            TrainOptions { model: ModelKind::Scaffold, ..TrainOptions::default() },
            TrainOptions { without: [Component::Harmonics].into(), ..TrainOptions::default() },
        ] {
            assert_eq!(degree(options), 1);
        }
    }

    #[test]
    fn growth_follows_the_weight_of_the_rate_once_it_counts() {
        let at = |options: TrainOptions, step: u32, lambda: f64| {
            Schedule::new(&options).growth_threshold_at(step, lambda)
        };
        for preset in [Preset::Preview, Preset::Standard] {
            let options = TrainOptions { preset, ..TrainOptions::default() };
            let Schedule { compression, steps, .. } = Schedule::new(&options);
            let CompressionSchedule { lambda, context_from, .. } = compression.expect("compression");
            let first = at(options.clone(), 1, lambda);
            assert!(first > growth::PUBLISHED);
            assert_eq!(at(options.clone(), context_from - 1, 4.0 * lambda), first, "not before it counts");
            assert_eq!(at(options.clone(), context_from, lambda), first, "no jump at the default weight");
            assert!((at(options.clone(), steps / 2, 4.0 * lambda) - 2.0 * first).abs() < 1e-9);
            let chosen = TrainOptions { lambda: Some(4.0 * lambda), ..options };
            assert_eq!(at(chosen, 1, 4.0 * lambda), first, "branches of a curve share what is before");
        }
        let published = [
            TrainOptions { preset: Preset::Paper, ..TrainOptions::default() },
            TrainOptions { model: ModelKind::Scaffold, ..TrainOptions::default() },
        ];
        for options in published {
            assert_eq!([1, 900, 14_000].map(|step| at(options.clone(), step, 0.01)), [2e-4; 3]);
        }
    }

    #[test]
    fn a_run_of_30_000_has_the_published_windows() {
        let options = TrainOptions { preset: Preset::Paper, ..TrainOptions::default() };
        let schedule = Schedule::new(&options);
        assert!(!schedule.gathers_statistics(500) && schedule.gathers_statistics(501));
        assert!(schedule.gathers_statistics(14_999) && !schedule.gathers_statistics(15_000));
        let at: Vec<u32> = (1..=30_000).filter(|step| schedule.densifies(*step)).collect();
        assert_eq!((at.first(), at.last()), (Some(&1600), Some(&14_900)));
        assert!(at.contains(&2900) && at.contains(&4000));
        assert!(!at.iter().any(|step| (3000..4000).contains(step)), "a pause for the noise");
        let baseline = TrainOptions { model: ModelKind::Scaffold, ..options };
        assert!(Schedule::new(&baseline).densifies(3000));
    }
}
