//! A job's history: a page at a time, or as a stream.

use axum::{
    Json,
    extract::State,
    http::{HeaderMap, HeaderName, StatusCode, header},
    response::IntoResponse as _,
};
use serde_json::json;

use super::{OwnedJob, body::href, event_stream};
use crate::{
    domain::{Caller, Event, JobId, ProblemType},
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        request::{Parameters, accepts, prefers},
        state::AppState,
    },
};

const DEFAULT_PAGE: u32 = 100;
const MAX_PAGE: u32 = 1000;
const STREAM: &str = "text/event-stream";
const PAGE: &str = "application/json";
const LAST_EVENT_ID: HeaderName = HeaderName::from_static("last-event-id");

/// `GET /v1/jobs/{id}/events`.
pub(crate) async fn list(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    caller: Caller,
    mut parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    let job = record.job;
    let stream = prefers(&headers, STREAM, PAGE);
    if !stream && !accepts(&headers, PAGE) {
        return Err(
            ProblemType::NotAcceptable.because(format!("events are served as {PAGE} and as {STREAM}"))
        );
    }
    // Streams ignore the limit, but an invalid one is refused all the same.
    let limit = parameters.take_count("limit", DEFAULT_PAGE, MAX_PAGE)?;
    let after: u64 = parameters.take_as("after", "an event number")?.unwrap_or(0);
    parameters.finish()?;
    let no_store = [(header::CACHE_CONTROL, "no-store")];
    let seen = last_event_id(&headers)?;
    if stream {
        let (after, more) = after_in_history(&state, job.id, seen.unwrap_or(after), 1).await?;
        if job.state.is_terminal() && more.is_empty() {
            return Ok((StatusCode::NO_CONTENT, no_store).into_response());
        }
        let slot = event_stream::slot(&state, &caller)?;
        return Ok(event_stream::answer(state, &caller, job.id, after, slot));
    }
    let (after, events) = after_in_history(&state, job.id, after, limit).await?;
    let last = events.last().map_or(after, |event| event.seq);
    let next = format!("{}/events?after={last}&limit={limit}", href(job.id));
    Ok((no_store, Json(json!({ "events": events, "next": next }))).into_response())
}

/// Up to `limit` events after number `after`, or after the newest one if that is earlier: a restored backup has fewer events than its
/// clients have seen, and they are to see those that follow. Returns the number, too.
async fn after_in_history(
    state: &AppState,
    job: JobId,
    after: u64,
    limit: u32,
) -> ApiResult<(u64, Vec<Event>)> {
    let no_job = || ProblemResponse::no_job(job);
    let events = state.store().events(job, after, limit).await?.ok_or_else(no_job)?;
    if !events.is_empty() {
        return Ok((after, events));
    }
    let newest = state.store().newest_events(&[job]).await?;
    let (_, newest) = newest.first().ok_or_else(no_job)?;
    Ok((after.min(*newest), events))
}

/// The last event that a reconnecting client has seen. It overrides `after`, which such a client repeats.
fn last_event_id(headers: &HeaderMap) -> ApiResult<Option<u64>> {
    let Some(value) = headers.get(LAST_EVENT_ID) else { return Ok(None) };
    let number = value.to_str().ok().and_then(|text| text.trim().parse().ok());
    number.map(Some).ok_or_else(|| ProblemResponse::parameter("Last-Event-ID", "is not an event number"))
}
