//! A job's training history as one series of points, across interruptions.

use crate::{
    domain::{Job, SeriesPoint, with_cumulative_seconds},
    store::{Store, StoreError},
};

/// The points up to the job's current step, ordered by step, in total seconds of work.
#[derive(Debug, Default)]
pub(super) struct History {
    points: Vec<SeriesPoint>,
    /// Seconds of work until the latest report, measuring included.
    pub(super) end: f64,
}

impl History {
    /// Reads the history of a job.
    pub(super) async fn read(store: &Store, job: &Job) -> Result<Self, StoreError> {
        let points = store.series(job.id).await?.unwrap_or_default();
        Ok(Self::of(points, job.attempt, job.progress.elapsed_seconds))
    }

    /// Of a job whose latest attempt has taken `elapsed_seconds` of its own.
    fn of(points: Vec<SeriesPoint>, attempt: u32, elapsed_seconds: f64) -> Self {
        let points = with_cumulative_seconds(points);
        let before = points.iter().rfind(|point| point.attempt != attempt).map_or(0.0, |point| point.seconds);
        Self { points, end: before + elapsed_seconds }
    }

    /// The pairs of figures that both are known for, as `x` and `y` give them.
    pub(super) fn points(
        &self,
        x: impl Fn(&SeriesPoint) -> Option<f64>,
        y: impl Fn(&SeriesPoint) -> Option<f64>,
    ) -> Vec<(f64, f64)> {
        self.points.iter().filter_map(|point| Some((x(point)?, y(point)?))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(attempt: u32, step: u64, seconds: f64, psnr: Option<f64>) -> SeriesPoint {
        SeriesPoint { attempt, step, seconds, psnr, ..SeriesPoint::default() }
    }

    #[test]
    fn an_attempt_that_goes_on_continues_the_line_and_the_work_ends_after_its_last_point() {
        let first = [point(1, 0, 1.0, None), point(1, 10, 5.0, Some(20.0))];
        let went_on = [point(2, 20, 0.5, Some(21.0)), point(2, 40, 4.5, Some(23.0))];
        let history = History::of([first.clone(), went_on].concat(), 2, 6.0);
        let line = history.points(|point| Some(point.seconds), |point| point.psnr);
        assert_eq!(line, [(5.0, 20.0), (5.5, 21.0), (9.5, 23.0)]);
        assert_eq!(history.end, 11.0);
        assert_eq!(History::of(first.into(), 1, 7.0).end, 7.0);
        assert_eq!(History::of(Vec::new(), 0, 0.0).end, 0.0);
    }
}
