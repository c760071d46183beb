//! What finished jobs say about the time of the next one.
//!
//! Of the newest finished jobs of the same model and preset, those count whose photographs are nearest in pixels, on the adapters that
//! the newest of them trained on. The range has the fastest and the slowest of them. A step takes between as long as theirs and as many
//! times longer as there are more pixels: fewer pixels likewise. A range of few jobs is widened.

use std::collections::BTreeSet;

use crate::{domain::ValueRange, store::FinishedRun};

/// The newest jobs whose adapters count; adapters that were replaced are not among theirs for long.
const NEWEST: usize = 20;

/// Jobs whose figures make the range.
const MAX_JOBS: usize = 10;

/// What the finished jobs took.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Experience {
    /// How many jobs there are.
    pub(super) count: usize,
    /// Their adapters.
    pub(super) adapters: Vec<String>,
    /// Steps a second to be expected.
    pub(super) speed: ValueRange<f64>,
    /// Seconds of a job that are not training.
    pub(super) other_seconds: Option<ValueRange<f64>>,
}

impl Experience {
    /// Of `runs`, newest first, for photographs of `pixels` pixels; none without runs.
    pub(super) fn of(runs: &[FinishedRun], pixels: u64) -> Option<Self> {
        let current: BTreeSet<&str> = runs.iter().take(NEWEST).map(|run| &*run.adapter).collect();
        let is_usable = |run: &&FinishedRun| {
            current.contains(&*run.adapter) && run.steps_per_second > 0.0 && run.view_pixels > 0
        };
        let mut near: Vec<&FinishedRun> = runs.iter().filter(is_usable).collect();
        let ratio = |run: &FinishedRun| pixels as f64 / run.view_pixels as f64;
        let distance = |run: &FinishedRun| ratio(run).ln().abs();
        // A stable sort: of equal ones the newest.
        near.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
        near.truncate(MAX_JOBS);
        let speed = range(near.iter().flat_map(|run| {
            // The time of a step between none of which, and all of which, grows with the pixels.
            [1.0, ratio(run)].map(|ratio| run.steps_per_second / ratio)
        }))?;
        let others: Vec<f64> = near.iter().filter_map(|run| run.other_seconds).collect();
        let adapters: BTreeSet<&str> = near.iter().map(|run| &*run.adapter).collect();
        Some(Self {
            count: near.len(),
            adapters: adapters.into_iter().map(str::to_owned).collect(),
            speed: widened(speed, near.len()),
            other_seconds: range(others.iter().copied()).map(|other| widened(other, others.len())),
        })
    }

    /// The seconds of a training of `steps` steps.
    pub(super) fn train_seconds(&self, steps: u64) -> ValueRange<f64> {
        ValueRange { low: steps as f64 / self.speed.high, high: steps as f64 / self.speed.low }
    }
}

/// The range of `count` jobs, widened at both ends: by a factor of 1.5 for one job.
fn widened(range: ValueRange<f64>, count: usize) -> ValueRange<f64> {
    let factor = 1.0 + 0.5 / count.max(1) as f64;
    ValueRange { low: range.low / factor, high: range.high * factor }
}

fn range(values: impl Iterator<Item = f64>) -> Option<ValueRange<f64>> {
    values.fold(None, |range, value| {
        let ValueRange { low, high } = range.unwrap_or(ValueRange { low: value, high: value });
        Some(ValueRange { low: low.min(value), high: high.max(value) })
    })
}

/// The range with ends of two digits, which has all of it: no figure of another project's job is told exactly.
pub(super) fn rounded_outward(range: ValueRange<f64>) -> ValueRange<f64> {
    ValueRange { low: rounded(range.low, f64::floor), high: rounded(range.high, f64::ceil) }
}

fn rounded(value: f64, round: fn(f64) -> f64) -> f64 {
    if value <= 0.0 || !value.is_finite() {
        return 0.0;
    }
    let exponent = value.log10().floor() as i32 - 1;
    // By powers of ten from 1 on, which are exact.
    let factor = 10_f64.powi(exponent.abs());
    if exponent < 0 { round(value * factor) / factor } else { round(value / factor) * factor }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(adapter: &str, view_pixels: u64, steps_per_second: f64) -> FinishedRun {
        FinishedRun {
            adapter: adapter.to_owned(),
            view_pixels,
            steps_per_second,
            other_seconds: Some(steps_per_second),
        }
    }

    #[test]
    fn a_range_has_the_fastest_and_the_slowest_job_of_the_same_size() {
        assert_eq!(Experience::of(&[], 100), None);
        let runs = [run("a", 100, 12.0), run("a", 100, 8.0), run("b", 100, 10.0), run("a", 100, 9.0)];
        let experience = Experience::of(&runs, 100).expect("runs");
        assert_eq!((experience.count, &*experience.adapters), (4, &["a".to_owned(), "b".to_owned()][..]));
        let widening = 1.125;
        assert_eq!(experience.speed, ValueRange { low: 8.0 / widening, high: 12.0 * widening });
        let seconds = experience.train_seconds(1000);
        assert_eq!(seconds.high, 1000.0 / (8.0 / widening));
        let alone = Experience::of(&runs[..1], 100).expect("a run");
        assert_eq!(alone.speed, ValueRange { low: 8.0, high: 18.0 });
        assert_eq!(alone.other_seconds, Some(ValueRange { low: 8.0, high: 18.0 }));
        let several =
            runs.map(|run| FinishedRun { other_seconds: Some(30.0).filter(|_| run.adapter == "b"), ..run });
        let other = Experience::of(&several, 100).expect("runs").other_seconds;
        assert_eq!(other, Some(ValueRange { low: 20.0, high: 45.0 }), "one job of four has them");
    }

    #[test]
    fn another_size_takes_between_as_long_and_in_proportion() {
        let of = |pixels| Experience::of(&[run("a", 100, 12.0), run("a", 100, 12.0)], pixels).expect("runs");
        assert_eq!(of(400).speed, ValueRange { low: 3.0 / 1.25, high: 12.0 * 1.25 });
        assert_eq!(of(50).speed, ValueRange { low: 12.0 / 1.25, high: 24.0 * 1.25 });
    }

    #[test]
    fn the_nearest_sizes_count_and_adapters_that_were_replaced_do_not() {
        let mut runs: Vec<FinishedRun> = (0..NEWEST).map(|_| run("new", 1000, 10.0)).collect();
        runs.extend((0..5).map(|_| run("new", 100, 20.0)));
        runs.extend((0..50).map(|_| run("old", 100, 1.0)));
        let experience = Experience::of(&runs, 100).expect("runs");
        assert_eq!(experience.adapters, ["new"]);
        assert_eq!(experience.count, MAX_JOBS);
        assert_eq!(experience.speed.low, 10.0 / 1.05, "five of the size, and the nearest others");
        assert_eq!(experience.speed.high, 100.0 * 1.05);
    }

    #[test]
    fn ends_are_rounded_away_from_the_middle() {
        for (low, high, expected) in
            [(123.0, 127.0, (120.0, 130.0)), (0.01234, 9.99, (0.012, 10.0)), (0.0, 1.0, (0.0, 1.0))]
        {
            let ValueRange { low, high } = rounded_outward(ValueRange { low, high });
            assert_eq!((low, high), expected);
        }
    }
}
