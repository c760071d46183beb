//! A job's history, a page at a time.

use axum::{
    Json,
    extract::{Path, RawQuery, State},
    http::{HeaderMap, StatusCode, header},
    response::IntoResponse,
};
use serde::Serialize;

use super::{
    accept::accepts, job_body::href, jobs::find, problem::Fault, query::Parameters, state::AppState,
};
use crate::domain::{Caller, Event};

const DEFAULT_PAGE: u32 = 100;
const MAX_PAGE: u32 = 1000;

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
) -> Result<impl IntoResponse, Fault> {
    let parsed = find(&state, &caller, &id).await?.job.id;
    if !accepts(&headers, "application/json") {
        return Err(Fault::new(
            StatusCode::NOT_ACCEPTABLE,
            "not-acceptable",
            "Not acceptable",
            "events are served as application/json; this version has no event stream",
        ));
    }
    let mut parameters = Parameters::parse(query.as_deref())?;
    let limit = parameters.take_count("limit", DEFAULT_PAGE, MAX_PAGE)?;
    let after: u64 = parameters.take_as("after", "an event number")?.unwrap_or(0);
    parameters.finish()?;
    let events = state.store().events(parsed, after, limit).await?.ok_or_else(|| Fault::no_job(&id))?;
    let last = events.last().map_or(after, |event| event.seq);
    let next = format!("{}/events?after={last}&limit={limit}", href(parsed));
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(EventPage { events, next })))
}
