//! Decides when a run has converged, from views of the training set that are kept aside for it (METHOD.md §2.8).
//!
//! Invariants: the held-out views of a dataset are never read; what is decided depends only on scores and their steps; without
//! `until=converged` nothing is kept aside.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::domain::{Convergence, Frame, ValidationScore};

/// One of so many training views is kept aside, at least one and at most [`MAX_ASIDE`].
const VIEWS_PER_ASIDE: usize = 16;
const MAX_ASIDE: usize = 4;

/// Fewest training views of which one may be kept aside.
const MIN_VIEWS: usize = 8;

/// Scores in a run of full length.
const SCORES: u32 = 50;

/// Scores in the mean that is compared: single ones vary with the view trained on last.
const SMOOTHED: usize = 3;

/// Scores over which the mean has to have gained: a tenth of the run.
const PATIENCE: usize = 5;

/// Least gain in dB over that tenth with which a run goes on.
const MIN_GAIN_DB: f64 = 0.05;

/// The views kept aside of `views` training views, by index: the middle one of as many equal parts; none of too few.
pub(super) fn views_aside(views: usize) -> Vec<usize> {
    if views < MIN_VIEWS {
        return Vec::new();
    }
    let aside = (views / VIEWS_PER_ASIDE).clamp(1, MAX_ASIDE);
    (0..aside).map(|part| (2 * part + 1) * views / (2 * aside)).collect()
}

/// The scores of a run so far; part of a checkpoint.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Scores {
    /// The step of every score, and the bits of its PSNR in dB.
    all: Vec<(u32, u64)>,
    /// Set when the run has converged.
    converged: Option<Converged>,
}

/// When a run was found to have converged. Numbers as bits, since JSON does not preserve all of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Converged {
    step: u32,
    /// Best mean of the last tenth of the run, in dB.
    psnr: u64,
    /// How much it is above the best mean before, in dB.
    gain: u64,
}

impl Scores {
    /// The step after which the run was found to have converged.
    pub(super) fn converged_after(&self) -> Option<u32> {
        self.converged.map(|converged| converged.step)
    }
}

/// Watches a run.
#[derive(Debug, Clone)]
pub(super) struct Watch {
    /// Indices of the views kept aside among the training views.
    pub(super) aside: Vec<usize>,
    /// Steps in which they are kept aside.
    window: Range<u32>,
    /// The first steps after which the scene is rendered otherwise than before, so that their scores and later ones do not compare
    /// with earlier ones.
    disturbances: Vec<u32>,
    /// Steps of the whole schedule.
    steps: u32,
    every: u32,
}

impl Watch {
    /// A watch over a run of `steps` steps on `views` training views, which may be found to have converged in `window`.
    pub(super) fn new(steps: u32, views: usize, window: Range<u32>, disturbances: Vec<u32>) -> Self {
        let every = steps.div_ceil(SCORES).max(1);
        Self { aside: views_aside(views), window, disturbances, steps, every }
    }

    /// Whether the views are kept aside at `step`; from the first step at which they are not, they are trained on like the others.
    pub(super) fn keeps_aside(&self, scores: &Scores, step: u32) -> bool {
        !self.aside.is_empty() && self.window.contains(&step) && scores.converged.is_none()
    }

    /// Whether the views are scored after `step`.
    pub(super) fn scores_after(&self, scores: &Scores, step: u32) -> bool {
        self.keeps_aside(scores, step) && step.is_multiple_of(self.every)
    }

    /// Adds the mean PSNR of the views after `step`. Decides that the run has converged if the best smoothed score of the last tenth
    /// of the run is less than [`MIN_GAIN_DB`] above the best before.
    pub(super) fn observe(&self, scores: &mut Scores, step: u32, psnr: f64) {
        scores.all.push((step, psnr.to_bits()));
        let since = self.disturbances.iter().copied().filter(|at| *at <= step).max().unwrap_or(0);
        let comparable: Vec<f64> = scores
            .all
            .iter()
            .filter(|(step, _)| *step >= since)
            .map(|(_, bits)| f64::from_bits(*bits))
            .collect();
        let smoothed: Vec<f64> =
            comparable.windows(SMOOTHED).map(|window| window.iter().sum::<f64>() / SMOOTHED as f64).collect();
        let before = smoothed.len().saturating_sub(PATIENCE);
        if before == 0 {
            return;
        }
        let best = |means: &[f64]| means.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let (earlier, recent) = (best(&smoothed[..before]), best(&smoothed[before..]));
        if recent - earlier < MIN_GAIN_DB {
            let (psnr, gain) = (recent.to_bits(), (recent - earlier).max(0.0).to_bits());
            scores.converged = Some(Converged { step, psnr, gain });
        }
    }

    /// What to report of a run that took `steps` steps and `seconds` seconds.
    pub(super) fn report(&self, scores: &Scores, frames: &[Frame], steps: u32, seconds: f64) -> Convergence {
        let saved = self.steps.saturating_sub(steps);
        let given_up = scores.converged.map(|converged| {
            // As if the gain of the last tenth of the run went on to its end.
            f64::from_bits(converged.gain) / f64::from(PATIENCE as u32 * self.every) * f64::from(saved)
        });
        Convergence {
            views: self.aside.iter().map(|index| frames[*index].name.clone()).collect(),
            scores: scores
                .all
                .iter()
                .map(|(step, bits)| ValidationScore { step: u64::from(*step), psnr: f64::from_bits(*bits) })
                .collect(),
            converged_at: scores.converged_after().map(u64::from),
            psnr: scores.converged.map(|converged| f64::from_bits(converged.psnr)),
            full_steps: u64::from(self.steps),
            steps_saved: u64::from(saved),
            seconds_saved: seconds / f64::from(steps.max(1)) * f64::from(saved),
            psnr_given_up: given_up,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn watch(disturbances: Vec<u32>) -> Watch {
        Watch::new(1000, 32, 1..900, disturbances)
    }

    /// The step after which a run with these scores has converged.
    fn converged(watch: &Watch, psnr: impl Fn(u32) -> f64) -> Option<u32> {
        let mut scores = Scores::default();
        for step in 1..=1000 {
            if watch.scores_after(&scores, step) {
                watch.observe(&mut scores, step, psnr(step));
            }
        }
        scores.converged_after()
    }

    #[test]
    fn views_are_spread_over_the_set_and_few_sets_have_none_to_spare() {
        assert!((0..MIN_VIEWS).all(|views| views_aside(views).is_empty()));
        assert_eq!(views_aside(8), [4]);
        assert_eq!(views_aside(31), [15]);
        assert_eq!(views_aside(32), [8, 24]);
        assert_eq!(views_aside(1000), [125, 375, 625, 875]);
    }

    #[test]
    fn a_run_that_gains_goes_on_and_one_that_stops_gaining_has_converged_a_tenth_later() {
        let watch = watch(Vec::new());
        assert_eq!(converged(&watch, |step| 20.0 + f64::from(step) / 1000.0), None, "0.1 dB a tenth");
        let stalls = |step: u32| 20.0 + f64::from(step.min(400)) / 100.0;
        // The mean of three scores still gains for two after the last.
        assert_eq!(converged(&watch, stalls), Some(540));
        assert_eq!(converged(&watch, |step| 20.0 - f64::from(step) / 100.0), Some(160), "it falls");
        assert_eq!(converged(&watch, |_| f64::NAN), None);
    }

    #[test]
    fn scores_from_before_a_disturbance_do_not_count() {
        let drops = |step: u32| if step <= 300 { 25.0 } else { 20.0 + f64::from(step) / 1000.0 };
        assert_eq!(converged(&watch(vec![140, 320]), |step| drops(step.max(200))), Some(280));
        assert_eq!(converged(&watch(vec![80, 140, 200, 260, 320]), drops), None);
        assert!(converged(&watch(Vec::new()), drops).is_some());
        // The score after the disturbing step is of the disturbed scene.
        let falls = |step: u32| if step < 200 { 25.0 } else { 20.0 + f64::from(step) / 1000.0 };
        assert_eq!(converged(&watch(vec![60, 200]), falls), None);
    }

    #[test]
    fn views_return_once_the_run_has_converged_or_can_no_longer() {
        let watch = watch(Vec::new());
        let mut scores = Scores::default();
        assert!(watch.keeps_aside(&scores, 899) && !watch.keeps_aside(&scores, 900));
        for step in (20..=160).step_by(20) {
            assert!(watch.keeps_aside(&scores, step));
            watch.observe(&mut scores, step, 20.0);
        }
        assert!(!watch.keeps_aside(&scores, 161));
        assert!(!Watch::new(1000, 7, 1..900, Vec::new()).keeps_aside(&Scores::default(), 1));
    }

    #[test]
    fn a_report_states_what_was_saved_and_extrapolates_the_last_gain() {
        let watch = Watch::new(1000, 4, 1..900, Vec::new());
        let converged = Converged { step: 400, psnr: 21.0_f64.to_bits(), gain: 0.04_f64.to_bits() };
        let scores = Scores { all: vec![(20, 19.5_f64.to_bits())], converged: Some(converged) };
        let report = watch.report(&scores, &[], 600, 30.0);
        assert_eq!((report.converged_at, report.steps_saved, report.full_steps), (Some(400), 400, 1000));
        assert!((report.seconds_saved - 20.0).abs() < 1e-9);
        // 0.04 dB in 100 steps, over 400.
        assert!((report.psnr_given_up.expect("stated") - 0.16).abs() < 1e-9);
        assert_eq!(report.scores, [ValidationScore { step: 20, psnr: 19.5 }]);
    }
}
