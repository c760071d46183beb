//! A job's history: a page at a time, or as a stream.

use axum::{
    Json,
    extract::{Path, RawQuery, State},
    http::{HeaderMap, HeaderName, StatusCode, header},
    response::{IntoResponse as _, Response},
};
use serde::Serialize;

use super::{
    accept::{accepts, prefers},
    event_stream,
    job_body::href,
    jobs::find,
    problem::Fault,
    query::Parameters,
    state::AppState,
};
use crate::domain::{Caller, Event};

const DEFAULT_PAGE: u32 = 100;
const MAX_PAGE: u32 = 1000;
const STREAM: &str = "text/event-stream";
const PAGE: &str = "application/json";
const LAST_EVENT_ID: HeaderName = HeaderName::from_static("last-event-id");

#[derive(Debug, Serialize)]
struct EventPage {
    events: Vec<Event>,
    next: String,
}

/// `GET /v1/jobs/{id}/events`.
pub(super) async fn list(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(query): RawQuery,
    headers: HeaderMap,
) -> Result<Response, Fault> {
    let job = find(&state, &caller, &id).await?.job;
    let stream = prefers(&headers, STREAM, PAGE);
    if !stream && !accepts(&headers, PAGE) {
        return Err(Fault::new(
            StatusCode::NOT_ACCEPTABLE,
            "not-acceptable",
            "Not acceptable",
            format!("events are served as {PAGE} and as {STREAM}"),
        ));
    }
    let mut parameters = Parameters::parse(query.as_deref())?;
    // A stream has no pages; the parameter is looked at all the same, so that a wrong one is refused either way.
    let limit = parameters.take_count("limit", DEFAULT_PAGE, MAX_PAGE)?;
    let after: u64 = parameters.take_as("after", "an event number")?.unwrap_or(0);
    parameters.finish()?;
    let no_store = [(header::CACHE_CONTROL, "no-store")];
    let seen = last_event_id(&headers)?;
    if stream {
        let after = seen.unwrap_or(after);
        let more = state.store().events(job.id, after, 1).await?.ok_or_else(|| Fault::no_job(&id))?;
        if job.state.is_terminal() && more.is_empty() {
            return Ok((StatusCode::NO_CONTENT, no_store).into_response());
        }
        let place = state.stream_places().take(&caller)?;
        return Ok(event_stream::answer(state, &caller, job.id, after, place));
    }
    let events = state.store().events(job.id, after, limit).await?.ok_or_else(|| Fault::no_job(&id))?;
    let last = events.last().map_or(after, |event| event.seq);
    let next = format!("{}/events?after={last}&limit={limit}", href(job.id));
    Ok((no_store, Json(EventPage { events, next })).into_response())
}

/// The last event that a client which comes again has seen. It outweighs `after`, which such a client repeats.
fn last_event_id(headers: &HeaderMap) -> Result<Option<u64>, Fault> {
    let Some(value) = headers.get(LAST_EVENT_ID) else { return Ok(None) };
    let number = value.to_str().ok().and_then(|text| text.trim().parse().ok());
    number.map(Some).ok_or_else(|| Fault::parameter("Last-Event-ID", "is not an event number"))
}
