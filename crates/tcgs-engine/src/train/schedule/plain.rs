//! The schedule of plain Gaussians: the published one in fractions of the run.
//!
//! | what | published, of 30 000 steps | here |
//! |---|---|---|
//! | growth | after 500, before 15 000, every 100 | same fractions; every thirtieth of the run, 25 to 100 steps |
//! | opacity reset | every 3 000, before 15 000 | every tenth of the run, but 600 steps apart or more |
//! | one degree more | every 1 000 | every thirtieth of the run |
//! | mean | 1.6e-4 to 1.6e-6 times extent, exponential | times the square root of 30 000 / steps |
//! | constant color, other coefficients | 0.0025, a twentieth of it | times its fourth root |
//! | log-scale, quaternion | 0.005, 0.001 | times its fourth root |
//! | opacity | 0.05 | the same |
//!
//! Later versions of the published code halve the opacity's rate; the rate of the paper lets a short run recover from a
//! reset sooner. A reset needs some hundred steps to recover whatever the length of the run, hence the least distance.
//!
//! Adam moves a mean by no more than the sum of its rates: by an extent in 30 000 steps, but by a hundredth of it in 300, which
//! would end before Gaussians are where they belong. Hence the factors, which are one from 30 000 steps on and stay at their
//! values of 300 steps below those.

use super::{Decay, speedup};
use crate::domain::{Background, Preset, TrainOptions};

/// Steps that a reset of opacities needs to be made good.
const RECOVERY: u32 = 600;

/// The largest factor of the rate of means.
const MAX_SPEEDUP: f64 = 10.0;

/// When what happens to plain Gaussians, and how fast they learn.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::train) struct PlainSchedule {
    /// Growth happens after this step,
    pub densify_from: u32,
    /// before this one,
    pub densify_until: u32,
    /// and this many steps apart.
    pub densify_every: u32,
    /// Opacities are reset before this step only,
    pub reset_until: u32,
    /// and this many steps apart.
    pub reset_every: u32,
    /// Whether there is a reset where growth begins too: against a haze of the background's white.
    pub reset_first: bool,
    /// Steps between additions of a degree of spherical harmonics.
    pub degree_every: u32,
    /// Mean screen gradient, in half-image units, from which a Gaussian grows.
    pub growth_threshold: f32,
    /// Gaussians that growth does not go beyond.
    pub max_gaussians: usize,
    /// Learning rate of means, before it is multiplied by the scene's extent.
    pub mean: Decay,
    /// Of the constant color.
    pub color: f32,
    /// Of the other coefficients.
    pub coefficients: f32,
    /// Of opacity logits.
    pub opacity: f32,
    /// Of log-scales.
    pub log_scale: f32,
    /// Of quaternions.
    pub quat: f32,
}

impl PlainSchedule {
    /// The schedule of a run of `steps` steps.
    pub(in crate::train) fn new(options: &TrainOptions, steps: u32) -> Self {
        let part = |of_30_000: f64| (f64::from(steps) * of_30_000 / 30_000.0).round() as u32;
        let densify_until = part(15_000.0);
        let reset_every = part(3_000.0).max(RECOVERY);
        let speed = speedup(steps).sqrt().clamp(1.0, MAX_SPEEDUP);
        let slower = speed.sqrt() as f32;
        Self {
            densify_from: part(500.0),
            densify_until,
            densify_every: (steps / 30).clamp(25, 100),
            reset_until: densify_until,
            reset_every,
            reset_first: options.background == Background::White && reset_every < densify_until,
            degree_every: part(1_000.0).max(1),
            growth_threshold: 2e-4,
            max_gaussians: match options.preset {
                Preset::Preview => 100_000,
                Preset::Standard => 500_000,
                Preset::Paper => 2_000_000,
            },
            mean: Decay::exponential(speed * 1.6e-4, speed * 1.6e-6),
            color: slower * 0.0025,
            coefficients: slower * 0.0025 / 20.0,
            opacity: 0.05,
            log_scale: slower * 0.005,
            quat: slower * 0.001,
        }
    }

    /// The first stage of an anchor model: up to the step `until`, of one color from all sides, without resets.
    pub(super) fn first_stage(self, until: u32, max_gaussians: usize) -> Self {
        Self {
            densify_until: until,
            reset_until: 0,
            reset_first: false,
            degree_every: u32::MAX,
            max_gaussians,
            ..self
        }
    }

    /// Whether the views of `step` count for growth.
    pub(in crate::train) fn gathers_statistics(&self, step: u32) -> bool {
        step < self.densify_until
    }

    /// Whether Gaussians grow and are pruned after `step`.
    pub(in crate::train) fn densifies(&self, step: u32) -> bool {
        step > self.densify_from && step < self.densify_until && step.is_multiple_of(self.densify_every)
    }

    /// Whether opacities are reset after `step`.
    pub(in crate::train) fn resets(&self, step: u32) -> bool {
        let first = self.reset_first && step == self.densify_from;
        step < self.reset_until && (first || step.is_multiple_of(self.reset_every))
    }

    /// Whether what is too large is pruned at `step`: once opacities were reset.
    pub(in crate::train) fn prunes_large(&self, step: u32) -> bool {
        step > self.reset_every
    }

    /// Degree of spherical harmonics at `step`.
    pub(in crate::train) fn degree(&self, step: u32) -> u32 {
        (step / self.degree_every).min(3)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn schedule(steps: u32, background: Background) -> PlainSchedule {
        PlainSchedule::new(&TrainOptions { background, ..TrainOptions::default() }, steps)
    }

    fn at(steps: u32, happens: impl Fn(u32) -> bool) -> Vec<u32> {
        (1..=steps).filter(|step| happens(*step)).collect()
    }

    #[test]
    fn a_run_of_30_000_is_as_published() {
        let plain = schedule(30_000, Background::Black);
        let grows = at(30_000, |step| plain.densifies(step));
        assert_eq!((grows[0], grows[grows.len() - 1], grows.len()), (600, 14_900, 144));
        assert_eq!(at(30_000, |step| plain.resets(step)), [3_000, 6_000, 9_000, 12_000]);
        assert_eq!([999, 1_000, 2_500, 3_000, 30_000].map(|step| plain.degree(step)), [0, 1, 2, 3, 3]);
        assert!(!plain.prunes_large(3_000) && plain.prunes_large(3_100));
        assert!(plain.gathers_statistics(1) && !plain.gathers_statistics(15_000));
        assert_eq!(plain.mean, Decay::exponential(1.6e-4, 1.6e-6));
        let rates = [plain.color, plain.coefficients, plain.opacity, plain.log_scale, plain.quat];
        assert_eq!(rates, [0.0025, 0.0025 / 20.0, 0.05, 0.005, 0.001]);
        assert_eq!(schedule(100_000, Background::Black).mean, plain.mean);
        let white = schedule(30_000, Background::White);
        assert_eq!(at(30_000, |step| white.resets(step))[..2], [500, 3_000]);
    }

    #[test]
    fn shorter_runs_learn_faster_up_to_a_bound() {
        let rates = |steps: u32| {
            let plain = schedule(steps, Background::Black);
            [plain.mean.start, f64::from(plain.color), f64::from(plain.log_scale), f64::from(plain.quat)]
        };
        let lengths = [30_000, 10_000, 2_000, 1_000, 300];
        for pair in lengths.windows(2) {
            let [long, short] = [pair[0], pair[1]].map(rates);
            assert!(long.iter().zip(short).all(|(long, short)| *long < short), "{pair:?}");
        }
        assert_eq!(rates(1), rates(300));
        assert!((rates(300)[0] / rates(30_000)[0] - MAX_SPEEDUP).abs() < 1e-9);
        assert!((rates(300)[1] / rates(30_000)[1] - MAX_SPEEDUP.sqrt()).abs() < 1e-5);
    }

    #[test]
    fn short_runs_grow_often_and_recover_from_every_reset() {
        for (steps, grows, resets) in [(1, 0, 0), (100, 1, 0), (400, 7, 0), (2_000, 15, 1), (10_000, 48, 4)] {
            for background in [Background::Black, Background::White] {
                let plain = schedule(steps, background);
                assert_eq!(at(steps, |step| plain.densifies(step)).len(), grows, "{steps} steps");
                let at = at(steps, |step| plain.resets(step) && step > plain.densify_from);
                assert_eq!(at.len(), resets, "{steps} steps");
                assert!(at.iter().all(|step| step + RECOVERY <= steps));
            }
        }
    }
}
