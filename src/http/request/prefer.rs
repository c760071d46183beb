//! `Prefer: wait=N` (RFC 7240): delays the response until the job has finished or the time is up.
//!
//! A preference that is malformed or cannot be met is ignored, as the standard requires; `Preference-Applied` confirms one that was met.

use std::time::Duration;

use axum::http::{HeaderMap, HeaderValue};
use tokio::time::timeout;

use crate::{
    domain::JobId,
    http::{problem::ApiResult, state::AppState},
    store::JobRecord,
};

/// Longest wait.
const MAX_SECONDS: u32 = 60;

/// The seconds that the request is willing to wait, at most [`MAX_SECONDS`].
pub(crate) fn wait(headers: &HeaderMap) -> Option<u32> {
    let values = headers.get_all("prefer").iter().filter_map(|value| value.to_str().ok());
    let mut preferences = values.flat_map(|list| list.split(',')).filter_map(|preference| {
        let preference = preference.split(';').next()?;
        let (name, value) = preference.split_once('=')?;
        name.trim().eq_ignore_ascii_case("wait").then(|| value.trim().trim_matches('"'))
    });
    // The first of several counts.
    let value = preferences.next()?;
    let digits = !value.is_empty() && value.bytes().all(|b| b.is_ascii_digit());
    digits.then(|| value.parse().unwrap_or(MAX_SECONDS).min(MAX_SECONDS))
}

/// The job once it has finished or as it stands when the time is up, and whether the wait was granted; `None` if it is
/// deleted meanwhile.
pub(crate) async fn finished(
    state: &AppState,
    record: JobRecord,
    wait: Option<u32>,
) -> ApiResult<(Option<JobRecord>, Option<u32>)> {
    let Some(seconds) = wait else { return Ok((Some(record), None)) };
    let id = record.job.id;
    if !record.job.state.is_terminal() {
        let Ok(_place) = state.waits.try_acquire() else { return Ok((Some(record), None)) };
        let finish = until_finished(state, id);
        // Out of time or shutting down: the response is the job's current state.
        tokio::select! {
            _ = timeout(Duration::from_secs(seconds.into()), finish) => {}
            () = state.draining.cancelled() => {}
        }
    }
    Ok((state.store().job(id).await?, Some(seconds)))
}

async fn until_finished(state: &AppState, id: JobId) {
    let mut seen = 0;
    while let Some(newest) = state.watcher.changed(id, seen).await {
        match state.store().job(id).await {
            Ok(Some(record)) if !record.job.state.is_terminal() => seen = newest,
            // The caller reads it again and gets the same.
            _ => return,
        }
    }
}

/// Confirms that the wait was granted.
pub(crate) fn mark_applied(headers: &mut HeaderMap, seconds: Option<u32>) {
    if let Some(value) = seconds.and_then(|seconds| HeaderValue::try_from(format!("wait={seconds}")).ok()) {
        headers.insert("preference-applied", value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wait_is_found_among_other_preferences_and_bounded() {
        let seconds = |value: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert("prefer", HeaderValue::from_static(value));
            wait(&headers)
        };
        for (value, expected) in [
            ("wait=5", Some(5)),
            ("respond-async, wait=10", Some(10)),
            ("Wait = \"7\"; foo=bar", Some(7)),
            ("wait=3, wait=9", Some(3)),
            ("wait=0", Some(0)),
            ("wait=61", Some(60)),
            ("wait=99999999999999", Some(60)),
            ("wait", None),
            ("wait=", None),
            ("wait=-1", None),
            ("wait=soon", None),
            ("waiting=5", None),
        ] {
            assert_eq!(seconds(value), expected, "{value}");
        }
        assert_eq!(wait(&HeaderMap::new()), None);
    }
}
