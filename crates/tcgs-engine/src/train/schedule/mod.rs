//! The schedule of a run, in fractions of its length, so that presets of different lengths share one shape. `docs/SCHEDULE.md`
//! lists it for all presets.

mod compression;
mod growth;
mod plain;
mod table;

use std::ops::Range;

pub use compression::{BaseQuantStepRule, CompressionSchedule, CompressionStage};
pub(super) use plain::PlainSchedule;
pub use table::schedule_table;

use super::{MaskWeightGrowth, RateControl};
use crate::{
    domain::{Component, ModelKind, Preset, SceneFrame, TrainOptions, Voxel},
    init::{PassingUnits, VoxelRule},
    model::ModelShape,
};

/// Largest factor of the anchors' learning rates in short runs.
const MAX_SPEEDUP: f64 = 3.2;

/// Largest factor of the masks' learning rate in short runs: beyond it, one step moves a logit all the way to the level.
const MAX_MASK_SPEEDUP: f64 = 125.0;

/// How a learning rate decays from its first value to its last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DecayShape {
    /// By the same factor every step (METHOD.md §2.5).
    Exponential,
    /// With the square of the remaining fraction of the run.
    Quadratic,
}

/// A learning rate that decays from `start` to `end`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decay {
    /// At the first step.
    pub start: f64,
    /// At the last step.
    pub end: f64,
    /// How it decays in between.
    pub shape: DecayShape,
}

impl Decay {
    /// A learning rate that decays by the same factor every step, like the published ones.
    #[must_use]
    pub const fn exponential(start: f64, end: f64) -> Self {
        Self { start, end, shape: DecayShape::Exponential }
    }

    const fn constant(learning_rate: f64) -> Self {
        Self::exponential(learning_rate, learning_rate)
    }

    /// The learning rate at a fraction of the run.
    #[must_use]
    pub fn at(&self, fraction: f64) -> f64 {
        let fraction = fraction.clamp(0.0, 1.0);
        let left = 1.0 - fraction;
        match self.shape {
            DecayShape::Exponential => (left * self.start.ln() + fraction * self.end.ln()).exp(),
            DecayShape::Quadratic => self.end + left * left * (self.start - self.end),
        }
    }
}

/// How many times shorter a run of `steps` steps is than the published one of 30 000 steps.
pub(super) fn speedup(steps: u32) -> f64 {
    30_000.0 / f64::from(steps.max(1))
}

/// A published learning rate of anchors, adapted to a run of `steps` steps. Adam moves a parameter by at most the sum of its
/// learning rates, so in shorter runs they start larger and decay later. A linear decay would have a larger sum still, but keeps
/// the rates too high at the end, where masks are fixed and attributes rounded. The factor is the fourth root of the speedup, as
/// for the parameters of plain Gaussians other than means, so that no model gains from faster learning rates.
fn anchor_learning_rate(published: Decay, steps: u32) -> Decay {
    let factor = speedup(steps).sqrt().sqrt().min(MAX_SPEEDUP);
    if factor <= 1.0 {
        return published;
    }
    Decay { start: factor * published.start, end: published.end, shape: DecayShape::Quadratic }
}

/// The same for the render networks, which every anchor shares: they learn as fast in runs of up to 3000 steps as in one of 300, and
/// only then more slowly. Until then more of a run goes to what they have to learn from scratch, such as what differs between views.
fn network_learning_rate(published: Decay, steps: u32) -> Decay {
    let decay = anchor_learning_rate(published, steps);
    let start = published.start * speedup(steps).sqrt().min(NETWORK_SPEEDUP);
    if start > decay.start { Decay { start, shape: DecayShape::Quadratic, ..decay } } else { decay }
}

/// Largest factor of the render networks' learning rates in runs of more than 300 steps.
const NETWORK_SPEEDUP: f64 = 3.16;

/// Steps from which on anchors that were Gaussians begin with [`PassingUnits::RECTIFYING`]: shorter runs do not make up for what it
/// costs at first.
const RECTIFYING_FROM: u32 = 500;

/// The coarsest growth cell in lattice cells, as published: growth has three levels, each a quarter of the one before.
const COARSEST_GROWTH: u16 = 16;

/// The same in `preview`, whose lattice follows the points' spacing: two levels, the finest a quarter of that spacing. Its scenes
/// have so few bytes an anchor that two more bits an axis are 3 to 5 % of a file, and offsets say where Gaussians are.
const COARSEST_PREVIEW_GROWTH: u16 = 4;

/// Share of the run in which an anchor model whose points are random is plain Gaussians, and the most steps of it: after them the
/// surfaces are found, however long the run.
const PLAIN_SHARE: f64 = 0.2;
const MAX_PLAIN_STEPS: u32 = 500;

/// When offset masks learn, and how fast.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaskSchedule {
    /// First step at which they learn.
    pub from: u32,
    /// First step at which their loss counts.
    pub loss_from: u32,
    /// Last step at which they learn. After it, anchors without offsets are pruned and the masks stay fixed while the remaining
    /// parameters converge.
    pub until: u32,
    /// Learning rate of the logits, independent of the scene's extent.
    pub learning_rate: Decay,
    /// Weight of the mean logistic of the logits in the loss, for a lambda up to the preset's own.
    pub weight: f32,
    /// How the weight grows with lambda, so that an offset has to be worth the price of its bits (METHOD.md §4.1). None where it
    /// stays as published.
    pub growth: Option<MaskWeightGrowth>,
    /// The logit above which an offset makes Gaussians.
    pub level: f32,
}

impl MaskSchedule {
    /// Whether masks learn at `step`.
    #[must_use]
    pub fn learns(&self, step: u32) -> bool {
        (self.from..=self.until).contains(&step)
    }

    /// The loss's weight at `step`, where the rate term weighs `lambda`.
    #[must_use]
    pub fn weight_at(&self, step: u32, lambda: f64) -> f32 {
        if step < self.loss_from {
            return 0.0;
        }
        (f64::from(self.weight) * self.growth.map_or(1.0, |growth| growth.factor(lambda))) as f32
    }
}

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
            shape,
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

/// The `paper` preset has the published learning rate, weight and level (METHOD.md §4.1): masks learn from the first step,
/// and their loss counts from a third of the run. In shorter runs a learning rate for 30 000 steps would leave every logit near
/// its initial value, so there
/// - the learning rate grows as runs shorten, so that a logit can move equally far;
/// - the level is nearer: the logistic's slope at 0.01 is a twentieth of its slope at the initial logit, and Adam, whose second
///   moments average over a thousand steps, would move too slowly there;
/// - masks learn once growth has ended, as they would otherwise remove the offsets that growth starts from;
/// - the weight is larger, so that the loss removes offsets of little effect within half the steps, and grows with lambda.
fn masks(options: &TrainOptions, steps: u32) -> Option<MaskSchedule> {
    if !options.has(Component::Masks) {
        return None;
    }
    let part = |fraction: f64| (f64::from(steps) * fraction).round() as u32;
    let published = MaskSchedule {
        from: 1,
        loss_from: part(1.0 / 3.0) + 1,
        until: part(0.7),
        learning_rate: Decay::exponential(1e-2, 1e-4),
        weight: 5e-4,
        growth: None,
        level: logit(0.01),
    };
    if options.preset == Preset::Paper {
        return Some(published);
    }
    let scale = speedup(steps).clamp(1.0, MAX_MASK_SPEEDUP);
    Some(MaskSchedule {
        from: part(0.5) + 1,
        loss_from: part(0.5) + 1,
        until: part(0.75),
        learning_rate: Decay::exponential(
            scale * published.learning_rate.start,
            scale * published.learning_rate.end,
        ),
        weight: 1e-2,
        growth: Some(MaskWeightGrowth { from: compression::default_lambda(options.preset) }),
        level: logit(0.2),
    })
}

/// The number whose logistic is `share`.
fn logit(share: f64) -> f32 {
    (share / (1.0 - share)).ln() as f32
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
    fn rates_fall_between_their_ends() {
        let square = Decay { start: 3.0, end: 1.0, shape: DecayShape::Quadratic };
        assert_eq!([-1.0, 0.0, 0.5, 1.0, 2.0].map(|fraction| square.at(fraction)), [3.0, 3.0, 1.5, 1.0, 1.0]);
        let decay = Decay::exponential(1e-2, 1e-4);
        assert!((decay.at(0.0) - 1e-2).abs() < 1e-12);
        assert!((decay.at(0.5) - 1e-3).abs() < 1e-12);
        assert!((decay.at(1.0) - 1e-4).abs() < 1e-12);
        assert!((decay.at(2.0) - 1e-4).abs() < 1e-12);
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
    fn rates_of_anchors_in_shorter_runs_begin_faster_stay_so_longer_and_end_as_published() {
        let of =
            |steps: u32| Schedule::new(&TrainOptions { iterations: Some(steps), ..TrainOptions::default() });
        let rates = |schedule: &Schedule| {
            let [opacity, covariance, color] = schedule.networks;
            [schedule.offset, schedule.feature, schedule.scaling, opacity, covariance, color]
        };
        let published = rates(&of(30_000));
        assert_eq!(published.map(|rate| rate.start), [0.01, 0.0075, 0.007, 2e-3, 4e-3, 8e-3]);
        assert_eq!(rates(&of(100_000)), published);
        let factors = [
            (10_000, 1.316, 1.732),
            (2_000, 1.968, 3.16),
            (300, 3.162, 3.162),
            (1, MAX_SPEEDUP, MAX_SPEEDUP),
        ];
        for (steps, of_rows, of_networks) in factors {
            for (index, (rate, published)) in rates(&of(steps)).iter().zip(published).enumerate() {
                let factor = if index < 3 { of_rows } else { of_networks };
                assert!((rate.start / published.start - factor).abs() < 1e-3, "{steps} steps: {rate:?}");
                assert!((rate.end / published.end - 1.0).abs() < 1e-12, "{steps} steps: {rate:?}");
                assert_eq!((rate.shape, published.shape), (DecayShape::Quadratic, DecayShape::Exponential));
            }
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

    fn masks_of(options: TrainOptions) -> Option<MaskSchedule> {
        Schedule::new(&options).masks
    }

    #[test]
    fn masks_of_the_paper_preset_have_the_published_values() {
        let options = TrainOptions { preset: Preset::Paper, ..TrainOptions::default() };
        let masks = masks_of(options).expect("masks");
        assert_eq!((masks.from, masks.loss_from, masks.until), (1, 10_001, 21_000));
        assert_eq!((masks.learning_rate, masks.weight), (Decay::exponential(1e-2, 1e-4), 5e-4));
        assert!((masks.level + 4.595_12).abs() < 1e-5);
        assert_eq!([10_000, 10_001].map(|step| masks.weight_at(step, 1.0)), [0.0, 5e-4]);
        assert!(masks.learns(1) && masks.learns(21_000) && !masks.learns(21_001));
    }

    #[test]
    fn masks_cost_more_where_bits_do_and_no_less_than_at_the_presets_own_weight() {
        for preset in [Preset::Preview, Preset::Standard] {
            let own = compression::default_lambda(preset);
            for max_bytes in [None, Some(100_000)] {
                let options = TrainOptions { preset, max_bytes, ..TrainOptions::default() };
                let masks = masks_of(options).expect("masks");
                let at = |lambda: f64| masks.weight_at(masks.loss_from, lambda);
                assert_eq!([0.0, own / 5.0, own].map(at), [masks.weight; 3]);
                assert!((at(4.0 * own) / masks.weight - 4.0).abs() < 1e-6);
                assert!((at(f64::MAX) / masks.weight - 16.0).abs() < 1e-5, "some Gaussians are left");
                assert_eq!(masks.weight_at(masks.loss_from - 1, own), 0.0);
            }
        }
    }

    #[test]
    fn a_masks_way_is_the_same_in_runs_of_any_usual_length() {
        let way = |steps: u32| -> f64 {
            let options = TrainOptions { iterations: Some(steps), ..TrainOptions::default() };
            let masks = masks_of(options).expect("masks");
            assert_eq!(masks.from, masks.loss_from, "masks wait for their loss");
            let learning = (1..=steps).filter(|step| masks.learns(*step));
            learning.map(|step| masks.learning_rate.at(f64::from(step) / f64::from(steps))).sum()
        };
        for steps in [240, 500, 1_000, 2_000, 10_000, 30_000] {
            assert!((way(steps) - 4.46).abs() < 0.1, "{steps} steps: {}", way(steps));
        }
        assert!(way(60) < 2.0, "the shortest runs keep their steps small: {}", way(60));
    }

    #[test]
    fn masks_are_on_for_tcgs_unless_left_out_and_for_nothing_else() {
        assert!(masks_of(TrainOptions::default()).is_some());
        let without = [Component::Masks].into();
        assert_eq!(masks_of(TrainOptions { without, ..TrainOptions::default() }), None);
        let without = [Component::Wavelet].into();
        assert!(masks_of(TrainOptions { without, ..TrainOptions::default() }).is_some());
        for model in [ModelKind::Scaffold, ModelKind::Gaussians3d] {
            assert_eq!(masks_of(TrainOptions { model, ..TrainOptions::default() }), None);
        }
    }

    #[test]
    fn masks_settle_before_the_end_of_the_shortest_runs() {
        for steps in [1, 2, 3, 10, 400] {
            let options = TrainOptions { iterations: Some(steps), ..TrainOptions::default() };
            let masks = masks_of(options).expect("masks");
            assert!((1..=steps).contains(&masks.until), "{steps} steps: {masks:?}");
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
