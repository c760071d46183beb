//! The course of a training run as at most [`SERIES_POINTS`] points over its iterations.

use super::Progress;

/// Most points of a run.
pub const SERIES_POINTS: u32 = 1000;

/// One point of a run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SeriesPoint {
    /// The attempt that reported it.
    pub attempt: u32,
    /// Steps done.
    pub step: u64,
    /// Seconds since the attempt began.
    pub seconds: f64,
    /// Training loss, averaged over recent steps.
    pub loss: Option<f64>,
    /// Training PSNR in dB, averaged over recent steps.
    pub psnr: Option<f64>,
    /// Training SSIM, averaged over recent steps.
    pub ssim: Option<f64>,
    /// Anchors at that time.
    pub anchors: u64,
    /// Gaussians of the view rendered last.
    pub gaussians: u64,
    /// Estimated bytes of the file, once training measures them.
    pub bytes: Option<u64>,
}

/// Which of the run's [`SERIES_POINTS`] equal parts a report falls into, from 0.
#[must_use]
pub fn series_bucket(progress: &Progress) -> u32 {
    let last = SERIES_POINTS - 1;
    let part = u128::from(progress.step) * u128::from(last) / u128::from(progress.total.max(1));
    u32::try_from(part).unwrap_or(last).min(last)
}

/// The same points with the seconds of all attempts: those of an attempt that resumed from a checkpoint are added to those of the
/// attempts before it.
#[must_use]
pub fn with_cumulative_seconds(mut points: Vec<SeriesPoint>) -> Vec<SeriesPoint> {
    let (mut before, mut attempt, mut latest) = (0.0, None, 0.0);
    for point in &mut points {
        if attempt.is_some_and(|attempt| attempt != point.attempt) {
            before = latest;
        }
        attempt = Some(point.attempt);
        point.seconds += before;
        latest = point.seconds;
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_goes_on_where_an_attempt_went_on() {
        let points = [(1, 1, 10.0), (1, 2, 20.0), (3, 3, 5.0), (3, 4, 15.0)]
            .map(|(attempt, step, seconds)| SeriesPoint { attempt, step, seconds, ..SeriesPoint::default() });
        let seconds: Vec<f64> =
            with_cumulative_seconds(points.into()).into_iter().map(|point| point.seconds).collect();
        assert_eq!(seconds, [10.0, 20.0, 25.0, 35.0]);
    }

    #[test]
    fn parts_cover_the_run_evenly_and_nothing_falls_outside() {
        let bucket = |step, total| series_bucket(&Progress { step, total, ..Progress::default() });
        assert_eq!([bucket(0, 30_000), bucket(15_000, 30_000), bucket(30_000, 30_000)], [0, 499, 999]);
        assert_eq!([bucket(1, 10), bucket(10, 10)], [99, 999]);
        for (step, total) in [(0, 0), (5, 0), (11, 10), (u64::MAX, 1), (u64::MAX, u64::MAX)] {
            assert!(bucket(step, total) < SERIES_POINTS, "{step} of {total}");
        }
    }
}
