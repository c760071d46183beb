//! The schedule of plain Gaussians: the published one in fractions of the run.
//!
//! | what | published, of 30 000 steps | here |
//! |---|---|---|
//! | growth | after 500, before 15 000, every 100 | same fractions; every thirtieth of the run, 25 to 100 steps |
//! | opacity reset | every 3 000, before 15 000 | every tenth of the run, but 600 steps apart or more |
//! | one degree more | every 1 000 | every thirtieth of the run |
//! | mean | 1.6e-4 to 1.6e-6 times extent, exponential | times the square root of 30 000 / steps |
//! | constant color | 0.0025 | times the fourth root |
//! | other coefficients | a twentieth of it | times the square root, at most 8 |
//! | log-scale, quaternion | 0.005, 0.001 | times the fourth root |
//! | opacity | 0.05 | the same |
//!
//! Later versions of the published code halve the opacity's rate; the rate of the paper lets a short run recover from a
//! reset sooner. A reset needs some hundred steps to recover whatever the length of the run, hence the least distance.
//!
//! Adam moves a mean by no more than the sum of its rates: by an extent in 30 000 steps, but by a hundredth of it in 300, which
//! would end before Gaussians are where they belong. Hence the factors, which are one from 30 000 steps on and stay at their
//! values of 300 steps below those. Coefficients beyond the constant color have the lowest rate of all, so what differs between views
//! would come last: by the fourth root alone runs of 300 and 2000 steps lose half a dB and more (docs/ANALYSIS.md).

use super::{Decay, learning_rate::speedup};
use crate::domain::{Background, Preset, TrainOptions, options::MAX_GAUSSIANS};

/// Steps that a reset of opacities needs to be made good.
const RECOVERY: u32 = 600;

/// The largest factor of the rate of means.
const MAX_SPEEDUP: f64 = 10.0;

/// The same of the coefficients beyond the constant color.
const MAX_COEFFICIENT_SPEEDUP: f64 = 8.0;

/// The screen gradient from which Gaussians grow that are to be pruned to a number: half the published one, so that there are more to
/// choose from.
const GROWTH_BEFORE_PRUNING: f32 = 1e-4;

/// Rounds in which Gaussians are pruned to a number: in one, those that stand in for each other would all go.
const PRUNING_ROUNDS: u32 = 8;

/// Gaussians that a run which is pruned to a number may grow to, for each that is left.
const GROWN_FOR_EACH_KEPT: u32 = 2;

/// When plain Gaussians are pruned to a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::train) struct PruningToNumber {
    /// How many are left.
    pub target: usize,
    /// The first round is after this step,
    pub from: u32,
    /// and the last after this one.
    pub until: u32,
}

impl PruningToNumber {
    fn new(target: u32, from: u32, until: u32) -> Self {
        Self { target: target as usize, from, until }
    }

    /// The step of a round, from 0.
    fn step(&self, round: u32) -> u32 {
        self.from
            + (u64::from(self.until - self.from) * u64::from(round) / u64::from(PRUNING_ROUNDS - 1)) as u32
    }

    /// Whether pruning would begin after `step` with fewer than the target of `count` Gaussians.
    pub(in crate::train) fn is_missed(&self, step: u32, count: usize) -> bool {
        step == self.from && count < self.target
    }

    /// How many of `count` Gaussians stay after `step`: by the same factor in each of the rounds that are left. None where the step has
    /// no round.
    pub(in crate::train) fn kept_after(&self, step: u32, count: usize) -> Option<usize> {
        let mut rounds = (0..PRUNING_ROUNDS).map(|round| self.step(round));
        if !rounds.clone().any(|round| round == step) {
            return None;
        }
        // Short runs have several rounds after a step, which are one.
        let later = rounds.by_ref().filter(|round| *round > step).count() as f64;
        let (count, target) = (count as f64, self.target as f64);
        let share = later / (later + 1.0);
        Some((target * (count / target).max(1.0).powf(share)).round() as usize)
    }
}

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
    /// None where all Gaussians stay.
    pub pruning: Option<PruningToNumber>,
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
            growth_threshold: if options.target_gaussians.is_some() { GROWTH_BEFORE_PRUNING } else { 2e-4 },
            max_gaussians: options.max_gaussians.unwrap_or_else(|| usual_max_gaussians(options)) as usize,
            pruning: options
                .target_gaussians
                .map(|target| PruningToNumber::new(target, densify_until, part(0.75 * 30_000.0))),
            mean: Decay::exponential(speed * 1.6e-4, speed * 1.6e-6),
            color: slower * 0.0025,
            coefficients: speed.min(MAX_COEFFICIENT_SPEEDUP) as f32 * 0.0025 / 20.0,
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
            pruning: None,
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

/// Gaussians that growth does not go beyond unless an option bounds it: the preset's number, or enough to prune to a target.
fn usual_max_gaussians(options: &TrainOptions) -> u32 {
    let of_preset: u32 = match options.preset {
        Preset::Preview => 100_000,
        Preset::Standard => 500_000,
        Preset::Paper => 2_000_000,
    };
    let to_prune = options.target_gaussians.map_or(0, |target| target.saturating_mul(GROWN_FOR_EACH_KEPT));
    of_preset.max(to_prune).min(MAX_GAUSSIANS)
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
            [
                plain.mean.start,
                plain.color.into(),
                plain.coefficients.into(),
                plain.log_scale.into(),
                plain.quat.into(),
            ]
        };
        let lengths = [30_000, 10_000, 2_000, 1_000, 300];
        for pair in lengths.windows(2) {
            let [long, short] = [pair[0], pair[1]].map(rates);
            assert!(long.iter().zip(short).all(|(long, short)| *long < short), "{pair:?}");
        }
        assert_eq!(rates(1), rates(300));
        assert!((rates(300)[0] / rates(30_000)[0] - MAX_SPEEDUP).abs() < 1e-9);
        assert!((rates(300)[1] / rates(30_000)[1] - MAX_SPEEDUP.sqrt()).abs() < 1e-5);
        let coefficients = |steps| rates(steps)[2] / rates(30_000)[2];
        assert!((coefficients(300) - MAX_COEFFICIENT_SPEEDUP).abs() < 1e-5);
        assert!((coefficients(2_000) - 15_f64.sqrt()).abs() < 1e-5, "as means");
    }

    #[test]
    fn pruning_to_a_number_takes_the_same_share_in_each_round_and_ends_at_it() {
        for steps in [1, 2, 5, 30, 300, 10_000] {
            let options = TrainOptions { target_gaussians: Some(1000), ..TrainOptions::default() };
            let plain = PlainSchedule::new(&options, steps);
            let pruning = plain.pruning.expect("a number");
            let mut counts = vec![256_000];
            for step in 1..=steps {
                if let Some(kept) = pruning.kept_after(step, counts[counts.len() - 1]) {
                    assert!(!plain.densifies(step), "{steps} steps: growth and pruning after step {step}");
                    counts.push(kept);
                }
            }
            assert_eq!(counts.last(), Some(&1000), "{steps} steps");
            if steps >= 300 {
                assert_eq!(counts, [256_000, 128_000, 64_000, 32_000, 16_000, 8000, 4000, 2000, 1000]);
            }
            assert_eq!(pruning.kept_after(pruning.until, 900), Some(1000), "fewer all stay");
        }
    }

    #[test]
    fn growth_may_reach_twice_the_number_that_is_left() {
        let max = |preset, target_gaussians, max_gaussians| {
            let options = TrainOptions { preset, target_gaussians, max_gaussians, ..TrainOptions::default() };
            PlainSchedule::new(&options, 300).max_gaussians
        };
        assert_eq!(max(Preset::Preview, Some(150_000), None), 300_000);
        for target in [None, Some(1), Some(50_000)] {
            assert_eq!(max(Preset::Preview, target, None), 100_000, "{target:?}");
        }
        assert_eq!(max(Preset::Preview, Some(150_000), Some(160_000)), 160_000);
        assert_eq!(max(Preset::Paper, Some(MAX_GAUSSIANS), None), MAX_GAUSSIANS as usize);
    }

    #[test]
    fn a_target_is_missed_once_where_pruning_begins_with_fewer() {
        let options = TrainOptions { target_gaussians: Some(1000), ..TrainOptions::default() };
        let pruning = PlainSchedule::new(&options, 300).pruning.expect("a number");
        assert_eq!(at(300, |step| pruning.is_missed(step, 999)), [150]);
        assert!(at(300, |step| pruning.is_missed(step, 1000)).is_empty());
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
