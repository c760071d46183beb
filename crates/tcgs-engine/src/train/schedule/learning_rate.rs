//! How learning rates decay over a run, and how much faster short runs learn.

/// Largest factor of the anchors' learning rates in short runs.
const MAX_SPEEDUP: f64 = 3.2;

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

    pub(super) const fn constant(learning_rate: f64) -> Self {
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
/// for most parameters of plain Gaussians, so that no model gains from faster learning rates.
pub(super) fn anchor_learning_rate(published: Decay, steps: u32) -> Decay {
    let factor = speedup(steps).sqrt().sqrt().min(MAX_SPEEDUP);
    if factor <= 1.0 {
        return published;
    }
    Decay { start: factor * published.start, end: published.end, shape: DecayShape::Quadratic }
}

/// The same for the render networks, which every anchor shares: they learn as fast in runs of up to 3000 steps as in one of 300, and
/// only then more slowly. Until then more of a run goes to what they have to learn from scratch, such as what differs between views.
pub(super) fn network_learning_rate(published: Decay, steps: u32) -> Decay {
    let decay = anchor_learning_rate(published, steps);
    let start = published.start * speedup(steps).sqrt().min(NETWORK_SPEEDUP);
    if start > decay.start { Decay { start, shape: DecayShape::Quadratic, ..decay } } else { decay }
}

/// Largest factor of the render networks' learning rates in runs of more than 300 steps.
const NETWORK_SPEEDUP: f64 = 3.16;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{domain::TrainOptions, train::Schedule};

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
}
