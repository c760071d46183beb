//! When offset masks learn, how fast, and what they cost (METHOD.md §4.1).

use super::{Decay, compression, learning_rate::speedup};
use crate::{
    domain::{Component, Preset, TrainOptions},
    train::MaskWeightGrowth,
};

/// Largest factor of the masks' learning rate in short runs: beyond it, one step moves a logit all the way to the level.
const MAX_MASK_SPEEDUP: f64 = 125.0;

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

/// The `paper` preset has the published learning rate, weight and level (METHOD.md §4.1): masks learn from the first step,
/// and their loss counts from a third of the run. In shorter runs a learning rate for 30 000 steps would leave every logit near
/// its initial value, so there
/// - the learning rate grows as runs shorten, so that a logit can move equally far;
/// - the level is nearer: the logistic's slope at 0.01 is a twentieth of its slope at the initial logit, and Adam, whose second
///   moments average over a thousand steps, would move too slowly there;
/// - masks learn once growth has ended, as they would otherwise remove the offsets that growth starts from;
/// - the weight is larger, so that the loss removes offsets of little effect within half the steps, and grows with lambda.
pub(super) fn masks(options: &TrainOptions, steps: u32) -> Option<MaskSchedule> {
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
    use crate::{domain::ModelKind, train::Schedule};

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
}
