//! Finds the number of steps that fills given seconds, from runs whose speed varies.
//!
//! Speed changes with the number of anchors and the load of the machine, so one run's speed is a first guess. Once one run took less and
//! another more than the seconds, the next guess is on the power law through both, so it is never worse than them.

/// Relative tolerance of the seconds.
const TOLERANCE: f64 = 0.1;

/// Steps of a run, and the seconds that it took.
pub(super) type Run = (u64, f64);

/// The run nearest to `budget` seconds; the earliest of several.
pub(super) fn nearest(runs: &[Run], budget: f64) -> Option<usize> {
    let miss = |run: &Run| (run.1 - budget).abs();
    (0..runs.len()).min_by(|a, b| miss(&runs[*a]).total_cmp(&miss(&runs[*b])))
}

/// The steps to try next so that a run takes `budget` seconds; `None` if a run is near enough or the steps have been tried.
pub(super) fn next_steps(runs: &[Run], budget: f64) -> Option<u64> {
    let nearest = runs[nearest(runs, budget)?];
    if (nearest.1 - budget).abs() <= TOLERANCE * budget {
        return None;
    }
    let below = runs.iter().filter(|run| run.1 <= budget).max_by(|a, b| a.1.total_cmp(&b.1));
    let above = runs.iter().filter(|run| run.1 > budget).min_by(|a, b| a.1.total_cmp(&b.1));
    let steps = match (below, above) {
        (Some(&(few, short)), Some(&(many, long))) if few < many => {
            let share = (budget / short.max(1e-9)).ln() / (long / short.max(1e-9)).ln();
            few as f64 * (many as f64 / few.max(1) as f64).powf(share)
        }
        // More steps took fewer seconds: the machine's load dominates, so use the mean speed.
        (Some(a), Some(b)) => budget * (a.0 + b.0) as f64 / (a.1 + b.1),
        _ => budget * nearest.0 as f64 / nearest.1.max(1e-9),
    };
    let steps = (steps.round() as u64).clamp(1, u64::from(tcgs::domain::options::MAX_ITERATIONS));
    runs.iter().all(|run| run.0 != steps).then_some(steps)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The misses of the best run after each try, on a machine that takes `seconds` for so many steps at the given try.
    fn misses(first: u64, budget: f64, tries: usize, seconds: impl Fn(u64, usize) -> f64) -> Vec<f64> {
        let mut runs = vec![(first, seconds(first, 0))];
        let mut misses = Vec::new();
        for number in 1..=tries {
            if let Some(steps) = next_steps(&runs, budget) {
                runs.push((steps, seconds(steps, number)));
            }
            let best = runs[nearest(&runs, budget).expect("a run")];
            misses.push((best.1 - budget).abs() / budget);
        }
        misses
    }

    #[test]
    fn a_run_that_is_near_enough_is_left_alone() {
        assert_eq!(next_steps(&[(100, 95.0)], 100.0), None);
        assert_eq!(next_steps(&[(100, 50.0), (260, 109.0)], 100.0), None);
        assert_eq!(next_steps(&[], 100.0), None);
    }

    #[test]
    fn the_first_guess_is_proportional_and_the_next_lies_between() {
        assert_eq!(next_steps(&[(100, 25.0)], 100.0), Some(400));
        assert_eq!(next_steps(&[(100, 25.0), (400, 175.0)], 100.0), Some(268));
        assert_eq!(next_steps(&[(100, 60.0), (120, 30.0)], 100.0), Some(167), "the nearest one's speed");
        assert_eq!(next_steps(&[(300, 80.0), (200, 120.0)], 100.0), Some(250), "a mean speed");
    }

    #[test]
    fn a_run_of_one_step_cannot_be_shorter_and_nothing_is_tried_twice() {
        assert_eq!(next_steps(&[(1, 50.0)], 10.0), None);
        assert_eq!(next_steps(&[(7, 80.0), (8, 130.0)], 100.0), None);
    }

    #[test]
    fn steps_that_grow_slower_are_met_within_three_tries() {
        let slowing = |steps: u64, _: usize| 1e-4 * (steps as f64).powf(1.7);
        let misses = misses(300, 100.0, 3, slowing);
        assert!(misses[2] <= TOLERANCE, "{misses:?}");
    }

    #[test]
    fn a_machine_that_swings_by_half_never_makes_the_best_run_worse() {
        for seed in 0_usize..64 {
            let swinging = |steps: u64, number: usize| {
                let mood = [1.0, 0.7, 1.5, 1.1, 0.8, 1.3][(seed * 7 + number * (seed % 5 + 1)) % 6];
                0.1 * steps as f64 * mood
            };
            let misses = misses(300, 100.0, 4, swinging);
            assert!(misses.windows(2).all(|pair| pair[1] <= pair[0]), "{seed}: {misses:?}");
            assert!(misses[3] <= 0.5, "{seed}: {misses:?}");
        }
    }
}
