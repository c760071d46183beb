//! The schedule in fractions of the run, so that a preview and a run of 30 000 steps share one shape.

use crate::{
    domain::{Preset, TrainOptions, Voxel},
    model::{Shape, VoxelRule},
};

/// A learning rate that goes from `start` to `end` exponentially (method.md §1.6).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decay {
    /// At the first step.
    pub start: f64,
    /// At the last step.
    pub end: f64,
}

impl Decay {
    /// The rate at a fraction of the run.
    #[must_use]
    pub fn at(&self, fraction: f64) -> f64 {
        let fraction = fraction.clamp(0.0, 1.0);
        ((1.0 - fraction) * self.start.ln() + fraction * self.end.ln()).exp()
    }
}

const fn constant(rate: f64) -> Decay {
    Decay { start: rate, end: rate }
}

/// Cells between neighbouring points, which growth begins with: the coarsest growth cell is as large as their spacing.
const CELLS_PER_SPACING: f32 = 16.0;

/// When what happens, and how fast parameters learn.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// Steps in all.
    pub steps: u32,
    /// Widths of the anchor model.
    pub shape: Shape,
    /// How the edge of the anchors' cells is chosen.
    pub voxel: VoxelRule,
    /// First step whose view is added to the growth statistics.
    pub statistics_from: u32,
    /// First step at which anchors grow and are pruned.
    pub densify_from: u32,
    /// First step at which they no longer do.
    pub densify_until: u32,
    /// Steps between.
    pub densify_every: u32,
    /// Screen-gradient threshold of growth at the coarsest level.
    pub growth_threshold: f32,
    /// Anchors that growth does not go beyond.
    pub max_anchors: usize,
    /// Points that a set without a point cloud begins with.
    pub random_points: usize,
    /// Learning rate of offsets, before it is multiplied by the scene's extent.
    pub offset: Decay,
    /// Of features.
    pub feature: Decay,
    /// Of log-scalings.
    pub scaling: Decay,
    /// Of the opacity, covariance and colour networks.
    pub networks: [Decay; 3],
    /// Weight of the volume regulariser.
    pub volume_weight: f32,
}

impl Schedule {
    /// The schedule of a job's options.
    #[must_use]
    pub fn new(options: &TrainOptions) -> Self {
        let (default_steps, features, max_anchors, random_points) = match options.preset {
            Preset::Preview => (2_000, 32, 40_000, 10_000),
            Preset::Standard => (10_000, 50, 200_000, 20_000),
            Preset::Paper => (30_000, 50, 400_000, 100_000),
        };
        let steps = options.iterations.unwrap_or(default_steps);
        let part = |fraction: f64| (f64::from(steps) * fraction).round() as u32;
        Self {
            steps,
            shape: Shape { features, offsets: 10 },
            voxel: match options.voxel {
                Voxel::Auto => VoxelRule::OfSpacing(CELLS_PER_SPACING.recip()),
                Voxel::Published => VoxelRule::Published,
                Voxel::Edge(edge) => VoxelRule::Fixed(edge as f32),
            },
            statistics_from: part(500.0 / 30_000.0),
            densify_from: part(0.05),
            densify_until: part(0.5),
            // Short runs grow more often: growth, not the last decimal of the gradients' mean, is what they lack.
            densify_every: (steps / 30).clamp(25, 100),
            growth_threshold: 2e-4,
            max_anchors,
            random_points,
            offset: Decay { start: 0.01, end: 1e-4 },
            feature: constant(0.0075),
            scaling: constant(0.007),
            networks: [Decay { start: 2e-3, end: 2e-5 }, constant(4e-3), Decay { start: 8e-3, end: 5e-5 }],
            volume_weight: 0.01,
        }
    }

    /// Whether the views of `step` count for growth.
    #[must_use]
    pub fn gathers_statistics(&self, step: u32) -> bool {
        step > self.statistics_from && step < self.densify_until
    }

    /// Whether anchors grow and are pruned after `step`.
    #[must_use]
    pub fn densifies(&self, step: u32) -> bool {
        step > self.densify_from && step < self.densify_until && step.is_multiple_of(self.densify_every)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_decay_exponentially_between_their_ends() {
        let decay = Decay { start: 1e-2, end: 1e-4 };
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
    fn a_run_of_30_000_has_the_published_windows() {
        let options = TrainOptions { preset: Preset::Paper, ..TrainOptions::default() };
        let schedule = Schedule::new(&options);
        assert!(!schedule.gathers_statistics(500) && schedule.gathers_statistics(501));
        assert!(schedule.gathers_statistics(14_999) && !schedule.gathers_statistics(15_000));
        let at: Vec<u32> = (1..=30_000).filter(|step| schedule.densifies(*step)).collect();
        assert_eq!((at.first(), at.last()), (Some(&1600), Some(&14_900)));
    }
}
