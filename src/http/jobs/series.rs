//! `GET /v1/jobs/{id}/series`: a job's training curves as columns.

use axum::{
    Json,
    extract::State,
    http::{HeaderMap, HeaderValue, header},
    response::IntoResponse as _,
};
use serde_json::{Value, json};

use super::OwnedJob;
use crate::{
    domain::{SERIES_POINTS, SeriesPoint, with_cumulative_seconds},
    http::{
        problem::{ApiResult, ProblemResponse},
        request::{Etag, Parameters, not_modified},
        state::AppState,
    },
};

/// `GET /v1/jobs/{id}/series`.
pub(crate) async fn get(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    mut parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    let job = record.job;
    let at_most = parameters.take_count("points", SERIES_POINTS, SERIES_POINTS)?;
    parameters.finish()?;
    let etag = Etag::new(job.version);
    if etag.is_in_if_none_match(&headers) {
        return Ok(not_modified(&etag));
    }
    let points = state.store().series(job.id).await?.ok_or_else(|| ProblemResponse::no_job(job.id))?;
    let cache = (header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    let body = columns(&thin(with_cumulative_seconds(points), at_most as usize));
    Ok(([(header::ETAG, etag.value()), cache], Json(body)).into_response())
}

/// At most `at_most` points, evenly chosen, with the first and the last; for one, the last.
fn thin(points: Vec<SeriesPoint>, at_most: usize) -> Vec<SeriesPoint> {
    let count = points.len();
    if count <= at_most {
        return points;
    }
    let (last, gaps) = (count - 1, at_most.saturating_sub(1));
    let mut wanted = (0..=gaps).map(|place| (place * last).checked_div(gaps).unwrap_or(last)).peekable();
    let is_wanted = |(index, point)| (wanted.next_if_eq(&index)).map(|_| point);
    points.into_iter().enumerate().filter_map(is_wanted).collect()
}

/// `#/components/schemas/Series` of the contract: columns of one length.
fn columns(points: &[SeriesPoint]) -> Value {
    fn column<T: Into<Value>>(points: &[SeriesPoint], of: impl Fn(&SeriesPoint) -> T) -> Value {
        points.iter().map(of).collect()
    }
    json!({
        "attempt": column(points, |point| point.attempt),
        "step": column(points, |point| point.step),
        "seconds": column(points, |point| point.seconds),
        "loss": column(points, |point| point.loss),
        "psnr": column(points, |point| point.psnr),
        "ssim": column(points, |point| point.ssim),
        "anchors": column(points, |point| point.anchors),
        "gaussians": column(points, |point| point.gaussians),
        "bytes": column(points, |point| point.bytes),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_thinned_evenly_between_the_first_and_the_last() {
        let steps = |count, at_most| -> Vec<u64> {
            let points = (0..count).map(|step| SeriesPoint { step, ..SeriesPoint::default() }).collect();
            thin(points, at_most).into_iter().map(|point| point.step).collect()
        };
        assert_eq!(steps(9, 3), [0, 4, 8]);
        assert_eq!(steps(10, 4), [0, 3, 6, 9]);
        assert_eq!(steps(3, 3), [0, 1, 2]);
        assert_eq!(steps(5, 1), [4]);
        assert_eq!(steps(0, 5), [0; 0]);
        for (count, at_most) in [(1000, 999), (1000, 2), (7, 5)] {
            let kept = steps(count, at_most);
            assert_eq!((kept.len(), kept[0], kept.last()), (at_most, 0, Some(&(count - 1))));
        }
    }
}
