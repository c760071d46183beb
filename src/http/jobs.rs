//! Jobs: list, get, cancel.

use axum::{
    Json,
    extract::{Path, RawQuery, State},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use jiff::Timestamp;
use serde::Serialize;

use super::{
    etag::{Etag, not_modified},
    job_body::JobBody,
    prefer,
    problem::Fault,
    query::Parameters,
    state::AppState,
};
use crate::{
    domain::{Caller, JobId},
    store::{Cancellation, JobFilter, JobRecord, PageKey},
};

const DEFAULT_PAGE: u32 = 20;
const MAX_PAGE: u32 = 100;
/// Seconds after which a client that polls an unfinished job should ask again.
const POLL_SECONDS: u32 = 2;

/// The job that a path names.
///
/// # Errors
/// 404 if there is none, and if it is another's.
pub(super) async fn find(state: &AppState, caller: &Caller, id: &str) -> Result<JobRecord, Fault> {
    let parsed: JobId = id.parse().map_err(|_| Fault::no_job(id))?;
    let record = state.store().job(parsed).await?;
    record.filter(|record| caller.may_see(record.owner)).ok_or_else(|| Fault::no_job(id))
}

#[derive(Debug, Serialize)]
struct JobList {
    jobs: Vec<JobBody>,
    next: Option<String>,
}

/// `GET /v1/jobs`.
pub(super) async fn list(
    State(state): State<AppState>,
    caller: Caller,
    RawQuery(query): RawQuery,
) -> Result<impl IntoResponse, Fault> {
    let mut parameters = Parameters::parse(query.as_deref())?;
    let limit = parameters.take_count("limit", DEFAULT_PAGE, MAX_PAGE)?;
    let before = parameters.take("cursor").map(|text| parse_cursor(&text)).transpose()?;
    parameters.finish()?;
    // One more than asked for tells whether there is a next page.
    let mut records = state.store().jobs(&JobFilter { owner: caller.sees_only() }, before, limit + 1).await?;
    let more = records.len() > limit as usize;
    records.truncate(limit as usize);
    let next =
        records.last().filter(|_| more).map(|last| format!("/v1/jobs?limit={limit}&cursor={}", cursor(last)));
    let jobs = records.into_iter().map(JobBody::from).collect();
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(JobList { jobs, next })))
}

fn cursor(last: &JobRecord) -> String {
    format!("{}.{}", last.job.created_at.as_microsecond(), last.job.id)
}

fn parse_cursor(text: &str) -> Result<PageKey, Fault> {
    let key = text.split_once('.').and_then(|(at, id)| {
        let created_at = Timestamp::from_microsecond(at.parse().ok()?).ok()?;
        Some(PageKey { created_at, id: id.parse().ok()? })
    });
    key.ok_or_else(|| Fault::parameter("cursor", "is not one that this service gave out"))
}

/// `GET /v1/jobs/{id}`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let (record, waited) = prefer::finished(&state, record, prefer::wait(&headers)).await?;
    let record = record.ok_or_else(|| Fault::no_job(&id))?;
    let etag = etag(&record);
    let mut response = if etag.is_in_if_none_match(&headers) {
        not_modified(&etag)
    } else {
        representation(record).into_response()
    };
    prefer::mark_applied(response.headers_mut(), waited);
    Ok(response)
}

fn etag(record: &JobRecord) -> Etag {
    Etag::new(record.job.version)
}

/// A job with the headers that belong to it.
pub(super) fn representation(record: JobRecord) -> impl IntoResponse {
    let mut headers = HeaderMap::new();
    headers.insert(header::ETAG, etag(&record).value());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if !record.job.state.is_terminal() {
        headers.insert(header::RETRY_AFTER, POLL_SECONDS.into());
    }
    (headers, Json(JobBody::from(record)))
}

/// `POST /v1/jobs/{id}/cancel`.
pub(super) async fn cancel(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Response, Fault> {
    let parsed = find(&state, &caller, &id).await?.job.id;
    match state.store().cancel(parsed).await?.ok_or_else(|| Fault::no_job(&id))? {
        Cancellation::Done(record) => Ok(representation(record).into_response()),
        Cancellation::Requested(record) => Ok((StatusCode::ACCEPTED, representation(record)).into_response()),
        Cancellation::TooLate(record) => Err(Fault::new(
            StatusCode::CONFLICT,
            "job-finished",
            "The job has finished",
            format!("job {parsed} has already {}; it cannot be cancelled", record.job.state.name()),
        )),
    }
}
